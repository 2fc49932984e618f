"""Bad numbers, and trials without one: refused, left out, told again, withdrawn."""

import os
import re
import time

import numpy as np
import pytest
import torch

from sbi_active.campaign.options import CampaignDetails
from sbi_active.seeding import row_normals
from sbi_active.simulation import Workers
from tests.campaign.problem import ACTIONS, PRIOR, campaign, draws, noisy
from tests.effects import BIAS

TOLD = [(1.0, 0.62), (3.0, 1.75), (0.5, 0.33)]  # action, x at theta = .6


def tell(c, told=TOLD, **bad):
    """Tell trials, ``bad`` the outcomes of some by their index."""
    for i, (action, x) in enumerate(told):
        c.tell(bad.get(f"x{i}", x), action=[action])
    return c


def scores(c):
    return [
        (t.surprise, t.log_score, t.misfit, t.outlyingness, t.information_gained)
        for t in c.history
    ]


@pytest.mark.parametrize(
    ("method", "bad"), [("nsbi", 1e15), ("nsbi", -1e30), ("alhi", 62.0)]
)
def test_a_number_that_nothing_explains_is_named_and_left_out(method, bad):
    c = tell(campaign(method), x0=bad)
    with pytest.warns(UserWarning, match=r"trial 0 at action \[1\]: x = \["):
        belief = c.update()
    diagnostics = belief.diagnostics
    assert diagnostics.trustworthy is False
    for text in ("trial 0", "correct or withdraw trial 0"):
        assert text in diagnostics.warnings[0]
    # Two measurements of noise .1 at actions .5 and 3.
    assert float(belief.mean) == pytest.approx(0.6, abs=0.1)
    assert float(belief.variance.sqrt()) < 0.12
    assert c.health == "alarm"
    assert [t.is_explained for t in c.history] == [False, True, True]
    assert c.ask().status == "pending"
    if bad == 1e15:
        assert c.criticize([], evaluate=False).verdict


def test_the_first_trial_alone_leaves_the_prior_marked():
    c = campaign()
    c.tell(1e15, action=[1.0])
    with pytest.warns(UserWarning, match="trial 0"):
        belief = c.update()
    assert belief.diagnostics.trustworthy is False
    theta = torch.linspace(0, 0.99, 5)[:, None]
    assert torch.equal(belief.log_prob(theta), PRIOR.log_prob(theta))
    assert c.update() is belief
    assert c.ask().index == 1


def test_a_number_beyond_all_simulations_but_near_stays_and_is_named():
    c = campaign()
    c.tell(2.5, action=[1.0])
    with pytest.warns(UserWarning, match="trial 0"):
        belief = c.update()
    assert belief.diagnostics.trustworthy is False
    assert "leaves it out" not in belief.diagnostics.warnings[0]
    assert float(belief.mean) > 0.9


@pytest.mark.parametrize("least", [1.1, 0.985])
def test_a_measurement_where_the_simulator_hardly_gives_one(least):
    def lost(theta, action):
        x = theta * action + 0.1 * torch.randn_like(theta)
        return torch.where((action == 3.0) & (theta < least), torch.nan, x)

    c = tell(campaign(simulator=lost, details=CampaignDetails(num_scored=1_000)))
    with pytest.warns(UserWarning, match="trial 1"):
        belief = c.update()
    assert belief.diagnostics.trustworthy is False
    if least > 1:  # no simulation has a number there
        assert float(belief.mean) == pytest.approx(0.6, abs=0.15)
        assert c.history[1].outlyingness == float("inf")
    c.ask()


@pytest.mark.filterwarnings("ignore:trial 0")
def test_a_corrected_trial_is_as_if_told_at_once():
    right, wrong = tell(campaign()), tell(campaign(), x0=1e15)
    right.update(), wrong.update()
    assert (right.health, wrong.health) == ("ok", "alarm")
    assert [t.outlyingness for t in right.history] == [None] * 3
    pending = wrong.ask()
    told = wrong.tell(TOLD[0][1], trial=0)
    assert (told.status, told.surprise) == ("ok", None)
    assert "corrected since" in wrong.belief.diagnostics.warnings[0]
    wrong.update()
    assert torch.equal(draws(right), draws(wrong))
    assert scores(right) == scores(wrong)
    assert wrong.health == "ok"
    assert wrong.ask() is pending  # it stays through a correction
    for c in (right, wrong):
        c.tell(1.8, action=[3.0])
        c.update()
    assert torch.equal(draws(right), draws(wrong))


@pytest.mark.filterwarnings("ignore:trial 1")
def test_a_withdrawn_trial_is_as_if_missing():
    missing, wrong = campaign(), tell(campaign(), x1=62.0)
    for i, (action, x) in enumerate(TOLD):
        missing.tell(x, action=[action], status="missing" if i == 1 else "ok")
    missing.update(), wrong.update()
    withdrawn = wrong.withdraw(1, reason="told in cm")
    assert (withdrawn.status, withdrawn.reason) == ("withdrawn", "told in cm")
    wrong.update()
    assert torch.equal(draws(missing), draws(wrong))
    assert scores(missing) == scores(wrong)
    assert [t.index for t in wrong.history] == [0, 1, 2]
    assert wrong.health == "ok"
    # And back again, with the right number.
    assert wrong.tell(TOLD[1][1], trial=1).reason == ""
    wrong.update()
    right = tell(campaign())
    right.update()
    assert torch.equal(draws(right), draws(wrong))


def test_a_pending_trial_can_be_withdrawn():
    c = campaign()
    c.withdraw(c.ask())
    assert c.pending is None
    assert c.ask().index == 1
    with pytest.raises(ValueError, match="the index of one of 2 trials; got 2"):
        c.withdraw(2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:trial [0-4] at action")
def test_a_correction_behind_an_adoption():
    told = [(a, 0.6 * a + 0.8) for a in (1.0, 3.0, 0.5, 3.0, 1.0)]
    campaigns = [tell(campaign(), told), tell(campaign(), told)]
    for c in campaigns:
        report = c.criticize([BIAS], evaluate=False)
        assert report.verdict == "bias"
        c.adopt(report)
    right, wrong = campaigns
    wrong.tell(500.0, trial=1)
    wrong.update()
    assert wrong.health == "alarm"
    assert wrong.belief.diagnostics.trustworthy is False
    truth = torch.tensor([0.6, 0.8])
    assert bool(((wrong.belief.mean - truth).abs() < 0.3).all())
    wrong.tell(told[1][1], trial=1)
    wrong.update()
    assert torch.equal(draws(right), draws(wrong))
    assert wrong.state.version.misfit == right.state.version.misfit
    assert [t.version for t in wrong.history] == [None] * 5
    for c in campaigns:
        c.tell(1.4, action=[1.0])
        c.update()
    assert torch.equal(draws(right), draws(wrong))
    assert scores(right)[-1] == scores(wrong)[-1]


#: What cannot be told, and what is said of it.
UNTELLABLE = [
    ({"x": "abc"}, "expected x of real numbers; got 'abc'"),
    ({"x": np.array([1e39])}, "expected x within +-3.4e38, the range of float32"),
    ({"x": 1.0, "action": [np.nan]}, "expected a finite action"),
    ({"x": 1.0, "action": [1.0, 2.0]}, "expected action of shape"),
    ({"x": 1.0, "status": "lost"}, "expected status 'ok', 'invalid' or"),
    ({"x": [1.0, 2.0]}, "expected x of shape (1,)"),
    ({}, "expected the outcome x; got None"),
]


@pytest.mark.parametrize(("told", "text"), UNTELLABLE)
def test_what_is_refused_leaves_no_trace(told, text):
    c = campaign()
    c.ask()
    with pytest.raises(ValueError, match=re.escape(text)):
        c.tell(**told)
    assert c.pending is not None
    assert c.history == ()


@pytest.mark.parametrize("make", [np.float32, torch.tensor, int, list])
def test_what_is_told_is_a_copy(make):
    c = campaign()
    told = [1.0] if make is list else make(1)
    array = np.array([0.5], dtype=np.float32)
    trial = c.tell(told, action=array)
    array[0] = 7.0
    assert trial.action.tolist() == [0.5]
    again = c.tell(array, action=[1.0])
    array[0] = 9.0
    assert again.x.tolist() == [7.0]
    assert (trial.x.tolist(), trial.x.dtype) == ([1.0], torch.float32)


def test_a_robot_that_changes_its_action_changes_no_record():
    c = campaign()

    def real_system(action):
        action *= 2.0
        return 0.3 * action

    c.run(real_system, num_rounds=1)
    assert bool(ACTIONS.contains(c.history[0].action))


# Campaigns whose trials, or simulators, give no measurement


def falls_off(theta, action):
    """Falls off the table where theta times action is above .8."""
    return torch.where(theta * action > 0.8, torch.nan, noisy(theta, action))


def test_each_kind_of_outcome_counts():
    """Above .4 by one trial, below .8 by another, .6 by a measurement."""
    c = campaign(simulator=falls_off)
    told = c.tell([3.0], status="invalid", action=[2.0])
    assert told.x.isnan().all()  # numbers told along with it are no measurement
    assert float(c.update().mean) == pytest.approx(0.7, abs=0.03)
    assert c.belief.label == "refined"
    assert c.belief.diagnostics.share_invalid > 0.2
    c.tell([0.62], action=[1.0])
    mean = float(c.update().mean)
    assert mean == pytest.approx(0.62, abs=0.05)
    c.tell(status="missing", action=[1.0])
    assert float(c.update().mean) == mean


class Faulty:
    """Raises on 5 % of the rows, NaN on 10 %; with a marker it hangs and dies, too."""

    def __init__(self, marker):
        self.marker = marker and str(marker)

    def __call__(self, theta, action, seeds):
        kind = seeds % 100
        if self.marker:
            if bool((kind == 50).any()) and not os.path.exists(self.marker):
                open(self.marker, "w").close()
                os._exit(1)
            if bool((kind == 5).any()):
                time.sleep(60)
        if bool((kind < 5).any()):
            raise RuntimeError("licence server")
        x = theta * action + 0.1 * row_normals(seeds, 1)
        return torch.where(((kind >= 10) & (kind < 20))[:, None], torch.nan, x)


@pytest.mark.parametrize("dies", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_faulty_simulator_completes_a_campaign(tmp_path, dies):
    faulty = Faulty(tmp_path / "killed" if dies else None)
    workers = Workers(2, time_limit=0.05) if dies else Workers()
    c = campaign("asbi", faulty, network="each round", workers=workers)
    with pytest.warns(UserWarning, match="are missing"):
        c.run(lambda action: 0.6 * action, num_rounds=2 if dies else 1)
    assert (tmp_path / "killed").exists() == dies
    for trial in c.history:
        # 5 or 6 % of the rows, and 3 times the Monte Carlo error.
        share = trial.num_missing / trial.num_simulations
        assert abs(share - 0.055) < 3 * (0.06 / trial.num_simulations) ** 0.5 + 0.01
    diagnostics = c.belief.diagnostics
    assert 0.05 < diagnostics.share_invalid < 0.15
    assert diagnostics.num_missing > 0
    assert float(c.belief.mean) == pytest.approx(0.6, abs=0.1)


def test_infinite_numbers_count_as_not_measured():
    def three(theta, action):
        return theta + 0.1 * torch.randn(len(theta), 3)

    c = campaign(simulator=three)
    with pytest.warns(UserWarning, match="2 of 3 told numbers are infinite"):
        trial = c.tell([0.6, torch.inf, -torch.inf], action=[2.0])
    assert trial.status == "ok"
    assert torch.equal(trial.x.isnan(), torch.tensor([False, True, True]))
    with pytest.warns(UserWarning, match="infinite"):
        assert c.tell([0.6, torch.inf, -torch.inf], trial=0, action=[2.0]) is trial
    assert float(c.update().mean) == pytest.approx(0.6, abs=0.1)
    assert c.history[0].surprise > 0.01
    with pytest.warns(UserWarning, match="3 of 3"):
        assert c.tell([torch.inf] * 3, action=[2.0]).status == "invalid"
