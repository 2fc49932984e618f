"""Bars and lines of a log of what takes its time."""

import logging
import time

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import SimulatorModel, StudentTNoise
from sbi_active.criticism import Trials, close_loop
from sbi_active.progress import News, stage
from tests.effects import BIAS

SOON = 0.05


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    """Call long what takes a twentieth of a second."""
    for name in ("long", "shown", "sign"):
        monkeypatch.setattr(News, name, SOON)
    monkeypatch.setattr(News, "tick", 0.01)


def lines(caplog):
    return [r.getMessage() for r in caplog.records if r.name == "sbi_active"]


def test_steps_tell_how_long_the_rest_will_take(caplog, capsys):
    caplog.set_level(logging.INFO, "sbi_active")
    done = 0
    with stage("folds", show_progress=True, count=lambda: (done, 10)):
        for _ in range(4):
            time.sleep(2 * SOON)
            done += 1
    said = lines(caplog)
    assert "0/10 [" in said[0]
    assert len(said) >= 4  # a sign of life now and then
    (late,) = [line for line in said if "3/10 [" in line][:1]
    assert late.startswith("folds:  30%|")
    rate = float(late.rsplit(",", 1)[1].removesuffix("it/s]"))
    assert 3 < rate < 12  # three steps of .1 s
    assert said[-1].startswith("folds took 0.")
    shown = capsys.readouterr().err
    assert "folds:  30%|" in shown


def test_an_error_is_told_and_what_is_within_is_not(caplog):
    caplog.set_level(logging.INFO, "sbi_active")

    def fail():
        with stage("inner"):
            time.sleep(3 * SOON)
        raise RuntimeError("stuck")

    with pytest.raises(RuntimeError, match="stuck"), stage("outer"):
        fail()
    said = lines(caplog)
    assert said[0] == "outer: 00:00"
    assert said[-1].startswith("outer ended with an error after 0.")
    assert not any("inner" in line for line in said)


def loop(**options):
    def slow(theta, action):
        time.sleep(0.001)
        return theta * action

    model = SimulatorModel(slow, noise=StudentTNoise(0.1, 9.0))  # of which samples tell
    action = torch.linspace(-1, 1, 6)[:, None]
    prior = BoxUniform(-5 * torch.ones(1), 5 * torch.ones(1))
    trials = Trials(action, 2 * action + 1)
    return close_loop(model, prior, trials, effects=[BIAS], **options)


def test_the_closed_loop_tells_of_its_stages(caplog, capsys, monkeypatch):
    for name in ("long", "shown", "tick"):  # however quick a stage is
        monkeypatch.setattr(News, name, 0.001)
    caplog.set_level(logging.INFO, "sbi_active")
    loop()  # imports, which take longer than stages
    loop(show_progress=True)
    shown, said = capsys.readouterr().err, "\n".join(lines(caplog))
    for told in (shown, said):
        assert "verdict, sets of effects fitted" in told
        assert "error before and after, a verdict without each trial" in told
        assert "/6 [" in told
