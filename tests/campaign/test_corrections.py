"""Bad numbers: refused, left out of the belief and named, told again, withdrawn."""

import re

import numpy as np
import pytest
import torch

from sbi_active.campaign.options import CampaignDetails
from tests.campaign.problem import ACTIONS, OPTIONS, PRIOR, RATIOS, campaign, draws  # noqa: F401 # others import them from here
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
    for text in ("trial 0", "tell(x, trial=0)", "withdraw(0)"):
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


@pytest.mark.parametrize(
    ("told", "text"),
    [
        ({"x": "abc"}, "expected x of real numbers; got 'abc'"),
        ({"x": np.array([1e39])}, "expected x within +-3.4e38, the range of float32"),
        ({"x": 1.0, "action": [np.nan]}, "expected a finite action"),
    ],
)
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
