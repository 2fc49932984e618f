"""What a campaign may do, and what it costs."""

import pytest

from sbi_active import Campaign, DiscreteActions
from sbi_active.campaign.options import CampaignDetails
from tests.campaign import problem
from tests.campaign.learning import test_revision as revised
from tests.campaign.problem import MODEL

ACTIONS = DiscreteActions([0.1, 1.0, 2.0, 3.0], names=["speed"], units=["m/s"])


def campaign(method="asbi", *, actions=ACTIONS, simulator=MODEL, limits=None, **more):
    """Return a campaign within limits; further fields are those of its details."""
    details = CampaignDetails(num_scored=200, **more)
    return problem.campaign(
        method, simulator, actions=actions, given=limits, details=details
    )


def below(speed):
    return lambda action: action[:, 0] <= speed


def above(speed):
    return lambda action: action[:, 0] >= speed


def measured(action):
    return 0.7 * action


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
def test_a_constraint_is_kept_by_designed_and_random_actions(method):
    c = campaign(method, limits={"constraint": below(1.5)})
    c.run(measured, num_rounds=3)
    assert all(float(t.action) <= 1.5 for t in c.history)
    if method == "asbi":
        assert float(c.history[0].action) == 1.0


@pytest.mark.parametrize(("constraint", "side"), [(None, -1), (above(0.5), 1)])
def test_a_constraint_is_kept_by_actions_about_the_model(constraint, side):
    c = Campaign(
        revised.MODEL,
        revised.PRIOR,
        revised.ACTIONS,
        effects=(revised.BIAS,),
        constraint=constraint,
        options=revised.OPTIONS,
    )
    for _ in range(2):
        c.tell([1.0], action=[2.0])
    trial = c.ask(target="model")
    assert side * float(trial.action) > 0
