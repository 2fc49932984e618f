"""The bar and the log of what a campaign is doing."""

import copy
import logging
import time

import pytest
import torch

from sbi_active import Campaign, progress
from sbi_active.campaign.display.progress import StageWatch
from sbi_active.campaign.state import CampaignState, Trial

from .storage.campaigns import MODEL, OPTIONS, go_on, new, outcome

SOON = 0.05


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    """Call long what takes a twentieth of a second."""
    monkeypatch.setattr(progress, "LONG", SOON)
    monkeypatch.setattr(progress, "SHOWN", SOON)
    monkeypatch.setattr(progress, "TICK", 0.01)


def state_with(*seconds):
    state = CampaignState("asbi", 0, OPTIONS, watch=StageWatch())
    for index, each in enumerate([*seconds, {}]):
        state.trials.append(Trial(index, torch.empty(0), seconds=each))
    return state


def lines(caplog):
    return [r.getMessage() for r in caplog.records if r.name == "sbi_active"]


def test_the_first_of_its_kind_says_so(caplog):
    caplog.set_level(logging.INFO, "sbi_active")
    with state_with().stage(0, "training"):
        time.sleep(4 * SOON)
    during, after = lines(caplog)
    assert during.startswith("trial 0: training, 0.1 s so far; it is the first")
    assert after.startswith("trial 0: training took 0.2 s")


def test_a_later_one_says_at_once_how_long_it_will_take(caplog):
    caplog.set_level(logging.INFO, "sbi_active")
    state = state_with({"training": 12.0}, {"design": 0.5})
    with state.stage(2, "training"):
        assert lines(caplog) == ["trial 2: training, about 12 s, as in trial 0"]


def test_one_that_takes_longer_than_before_is_told_of(caplog):
    caplog.set_level(logging.INFO, "sbi_active")
    with state_with({"training": 0.01}).stage(1, "training"):
        time.sleep(4 * SOON)
    assert "in trial 0 it took 0.0 s" in lines(caplog)[0]


def test_short_stages_and_quiet_programs_have_no_log(caplog):
    caplog.set_level(logging.INFO, "sbi_active")
    with state_with().stage(0, "training"):
        pass
    caplog.set_level(logging.WARNING, "sbi_active")
    with state_with().stage(0, "training"):
        time.sleep(3 * SOON)
    assert lines(caplog) == []


def test_an_error_passes_through(caplog):
    caplog.set_level(logging.INFO, "sbi_active")

    def failing():
        with state_with().stage(0, "training"):
            time.sleep(4 * SOON)
            raise ZeroDivisionError

    pytest.raises(ZeroDivisionError, failing)
    assert "ended with an error after" in lines(caplog)[-1]


def test_work_for_no_trial_is_named_by_what_it_does(caplog):
    caplog.set_level(logging.INFO, "sbi_active")
    state = state_with()
    with state.watch(state, 1, "criticism"):
        time.sleep(4 * SOON)
    assert lines(caplog)[-1].startswith("criticism took")


def test_bars_show_stages_and_rounds(capsys):
    campaign = new(simulator=MODEL, method="asbi", show_progress=True)
    campaign.run(lambda action: outcome(action, 0), num_rounds=2)
    shown = capsys.readouterr().err
    assert "rounds: 100%" in shown
    assert "2/2" in shown
    assert "trial 0: update: 00:00" in shown
    assert "of about" in shown  # the second update knows of the first


def test_without_it_nothing_is_shown(capsys, tmp_path):
    campaign = new(tmp_path / "c", simulator=MODEL)
    campaign.run(lambda action: outcome(action, 0), num_rounds=1)
    campaign.close()
    loaded = Campaign.load(tmp_path / "c", simulator=MODEL)
    go_on(loaded, 2)
    assert capsys.readouterr().err == ""


def test_a_watched_campaign_can_be_loaded_and_copied(tmp_path, capsys):
    go_on(new(tmp_path / "c", simulator=MODEL), 1).close()
    with Campaign.load(tmp_path / "c", simulator=MODEL, show_progress=True) as loaded:
        go_on(loaded, 2)
        twin = copy.deepcopy(loaded)
    assert "trial 1: update" in capsys.readouterr().err
    assert twin.state.watch.show_progress
