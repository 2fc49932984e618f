"""The benchmark of attacks counts what it should count."""

import os
import signal
import time

import pytest

from benchmarks.robustness.run import Attacks, attempt

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
