"""A campaign that compares its simulator with its trials and goes on with another."""

from dataclasses import replace

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.campaign.learning.planner import most_unlike
from sbi_active.campaign.options import CampaignDetails
from tests.campaign import problem
from tests.effects import BIAS, on_outcomes

PRIOR = BoxUniform(-2 * torch.ones(1), 2 * torch.ones(1))
ACTIONS = DiscreteActions([-2.0, -1.0, 1.0, 2.0])
MODEL = SimulatorModel(
    lambda theta, action: theta * action,
    noise=GaussianNoise(0.1),
    parameter_names=["slope"],
)
OPTIONS = replace(problem.OPTIONS, details=CampaignDetails(num_scored=400))
SHIFT = 0.8


DRIFT = on_outcomes(
    "drift", lambda x, phi, action, context: x + phi * context.index[:, None]
)
LIBRARY = [BIAS, DRIFT]


def campaign(simulator=MODEL, **changes):
    return Campaign(
        simulator, PRIOR, ACTIONS, method="nsbi", options=replace(OPTIONS, **changes)
    )


def tell(c, shift=SHIFT, actions=(1.0, -2.0, 2.0, -1.0, 2.0), per_trial=0.0):
    gen = torch.Generator().manual_seed(3)
    for i, action in enumerate(actions):
        x = 0.5 * action + shift + per_trial * i + 0.1 * torch.randn(1, generator=gen)
        c.tell(x, action=[action])


@pytest.fixture(scope="module")
def adopted():
    c = campaign()
    tell(c)
    c.update()
    before, health = c.belief, c.health
    report = c.criticize(LIBRARY, evaluate=False)
    c.adopt(report)
    return c, before, health, report


def test_a_hidden_bias_alarms_and_is_adopted(adopted):
    c, before, health, report = adopted
    assert health == "alarm"
    assert report.verdict == "bias"
    # The bare simulator explains the trials at no slope: its belief is as wide as they
    # scatter, and says so.
    assert not before.diagnostics.trustworthy
    assert before.diagnostics.noise_inflation > 3
    assert float(before.log_prob(torch.tensor([0.5]))) > -2
    assert c.simulator is report.simulator
    assert c.prior is report.prior
    # Five measurements of noise .1: below .1 each.
    truth = torch.tensor([0.5, SHIFT])
    assert bool(((c.belief.mean - truth).abs() < 4 * 0.1).all())
    assert float(c.belief.log_prob(truth)) > 0
    assert c.health == "ok"


def test_a_campaign_goes_on_after_an_adoption(adopted):
    c, *_ = adopted
    trial = c.ask()
    c.tell(0.5 * trial.action + SHIFT)
    c.update()
    told = c.history[-1]
    assert told.version == 1
    assert told.surprise > 1e-2
    again = c.criticize(LIBRARY, evaluate=False)
    assert again.verdict == "none"
    with pytest.raises(ValueError, match="expected a report whose verdict names eff"):
        c.adopt(again)


def test_a_report_of_another_model_is_refused(adopted):
    c, _, _, report = adopted
    with pytest.raises(ValueError, match="expected a report of the current model, ver"):
        c.adopt(report)
    assert len(c.state.versions) == 2


def test_every_second_trial_may_go_where_none_was():
    c = Campaign(MODEL, PRIOR, ACTIONS, options=replace(OPTIONS, check_every=2))
    actions = []
    for _ in range(4):
        actions.append(float(c.ask().action))
        c.tell([0.5 * actions[-1]])
    for index, (action, trial) in enumerate(zip(actions, c.history, strict=True)):
        executed = [torch.tensor([a]) for a in actions[:index]]
        unlike = most_unlike(ACTIONS, executed)
        is_check = index % 2 == 1
        assert trial.design.expected_information_gain.isnan().all() == is_check
        if is_check:
            assert action in unlike.values[:, 0].tolist()
