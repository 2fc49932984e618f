"""What a campaign may do, what it costs, and what its designs rest on."""

from dataclasses import replace

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails
from tests.campaign.learning.test_revision import ACTIONS as SIDES
from tests.campaign.learning.test_revision import BIAS, OPTIONS
from tests.campaign.learning.test_revision import MODEL as REVISED
from tests.campaign.learning.test_revision import PRIOR as SLOPES
from tests.campaign.sizes import REFINEMENT

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([0.1, 1.0, 2.0, 3.0], names=["speed"], units=["m/s"])
SMALL = CampaignOptions(
    num_simulations=400,
    num_samples=100,
    details=CampaignDetails(num_scored=200),
    density_estimator=MixtureDensity(
        hidden_features=(16,), num_components=2, num_iterations=100
    ),
    refinement=REFINEMENT,
)
MODEL = SimulatorModel(lambda t, a: a * t, noise=GaussianNoise(0.1))


def campaign(
    method="asbi", *, actions=ACTIONS, simulator=MODEL, limits=None, **changes
):
    options = replace(SMALL, **changes)
    return Campaign(
        simulator, PRIOR, actions, method=method, options=options, **(limits or {})
    )


def below(speed):
    return lambda action: action[:, 0] <= speed


def above(speed):
    return lambda action: action[:, 0] >= speed


def measured(action):
    return 0.7 * action


def test_without_limits_the_fastest_action_tells_most():
    assert campaign().ask().action.tolist() == [3.0]


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
def test_a_constraint_is_kept_by_designed_and_random_actions(method):
    c = campaign(method, limits={"constraint": below(1.5)})
    c.run(measured, num_rounds=3)
    assert all(float(t.action) <= 1.5 for t in c.history)
    if method == "asbi":
        assert float(c.history[0].action) == 1.0


def test_a_constraint_is_kept_in_a_box():
    box = BoxActions([0.0], [3.0])
    c = campaign(actions=box, limits={"constraint": below(1.5)})
    assert 1.2 < float(c.ask().action) <= 1.5


def test_a_constraint_and_no_repeats_are_kept_by_checks():
    c = campaign(
        limits={"constraint": below(2.5)},
        check_every=2,
        details=replace(SMALL.details, repeat=False),
    )
    c.run(measured, num_rounds=2)
    assert c.history[1].target == "check"
    # Of those below 2.5 the one farthest from the first, 2.0.
    assert float(c.history[1].action) == pytest.approx(0.1)


@pytest.mark.parametrize(("constraint", "side"), [(None, -1), (above(0.5), 1)])
def test_a_constraint_is_kept_by_actions_about_the_model(constraint, side):
    c = Campaign(
        REVISED, SLOPES, SIDES, effects=(BIAS,), constraint=constraint, options=OPTIONS
    )
    for _ in range(2):
        c.tell([1.0], action=[2.0])
    trial = c.ask(target="model")
    assert side * float(trial.action) > 0


def test_information_is_weighed_against_its_cost():
    dear = torch.tensor([1.0, 1.0, 1.0, 10.0])
    trial = campaign(limits={"cost": dear}).ask()
    assert float(trial.action) == 2.0
    assert trial.design.cost.tolist() == dear.tolist()
    gain = trial.design.expected_information_gain
    assert torch.equal(trial.design.utility, gain / dear)


def test_no_action_comes_twice_without_repeats():
    c = campaign("nsbi", details=replace(SMALL.details, repeat=False))
    c.run(measured, num_rounds=4)
    assert sorted(float(t.action) for t in c.history) == pytest.approx([0.1, 1, 2, 3])
    with pytest.raises(ValueError, match="expected a permitted action; got none of 4"):
        c.ask()


def test_actions_that_hardly_give_a_measurement_are_left_out():
    def breaks(theta, action):
        return torch.where(action > 2.5, torch.nan, action * theta)

    model = SimulatorModel(breaks, noise=GaussianNoise(0.1))
    for method in ("asbi", "nsbi"):
        c = campaign(
            method,
            simulator=model,
            details=replace(SMALL.details, min_probability_valid=0.5),
        )
        assert float(c.ask().action) <= 2.5
        assert float(c.pending.design.probability_valid[-1]) == 0.0


def test_a_design_by_the_simulations_of_the_training_costs_none():
    trained = campaign(
        details=replace(SMALL.details, design_on="training"), num_simulations=2_000
    ).ask()
    assert trained.num_simulations == 2_000
    assert trained.design.num_simulations == 0
    assert trained.design.stopped == "simulations given"
    assert float(trained.action) >= 2.0
    fresh = campaign(num_simulations=2_000).ask()
    assert fresh.num_simulations > 2_000


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"cost": torch.ones(3)}, "cost"),
        ({"cost": lambda action: 0 * action[:, 0]}, "positive"),
        ({"constraint": lambda action: torch.tensor(True)}, "expected a constraint"),
        ({"constraint": below(0.0)}, "got none of 4"),
    ],
)
def test_wrong_limits_are_an_error_at_once(limits, message):
    with pytest.raises(ValueError, match=message):
        campaign(limits=limits)


def test_an_unknown_source_of_designs_is_an_error():
    with pytest.raises(ValueError, match="expected design_on 'fresh' or 'training'"):
        replace(SMALL, details=CampaignDetails(design_on="stored"))
