"""The benchmark of attacks counts what it should count."""

import os
import signal
import time
from pathlib import Path

import pytest

from benchmarks.robustness.attacks import Attacks, attempt
from benchmarks.robustness.run import AREAS, ROOT, attacks_on, by_tests

ATTACKS = Attacks()


@ATTACKS.add("whatever", cases=("nothing", "raises", "hangs", "dies"), seconds=1.0)
def whatever(case):
    if case == "raises":
        raise ValueError("a wrong number")
    if case == "hangs":
        time.sleep(60)
    if case == "dies":
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("case", "answer"),
    [
        ("nothing", ""),
        ("raises", "ValueError in whatever: a wrong number"),
        ("hangs", "hangs: no end within 1 s"),
        ("dies", "its process died (exit -9)"),
    ],
)
def test_only_what_returns_is_survived(case, answer):
    outcome = attempt(ATTACKS[0], case)
    assert outcome.survived == (case == "nothing")
    assert outcome.answer == answer


@pytest.mark.parametrize("area", AREAS)
def test_an_area_has_tests_or_attacks_of_different_names(area):
    patterns = AREAS[area]
    assert all(any(Path(ROOT).glob(pattern)) for pattern in patterns)
    if not patterns:
        names = [attack.name for attack in attacks_on(area)]
        assert len(names) == len(set(names)) > 0


def test_a_test_is_an_attack_and_its_parameters_are_a_case():
    rows = [*by_tests(("tests/benchmarks/test_bits_benchmark.py",))]
    assert {row["survived"] for row in rows} == {True}
    assert rows[0]["attack"].endswith("test_bits_benchmark test_a_last_bit_counts")
