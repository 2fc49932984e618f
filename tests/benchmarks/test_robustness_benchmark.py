"""The benchmark of attacks counts what it should count."""

import importlib
import os
import signal
import time

import pytest

from benchmarks.robustness.attacks import Attacks, attempt
from benchmarks.robustness.run import AREAS, attacks_on

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
def test_an_area_names_each_attack_once(area):
    names = [attack.name for attack in attacks_on(area)]
    assert len(names) == len(set(names))
    assert importlib.import_module(f"benchmarks.robustness.{area}").__doc__
