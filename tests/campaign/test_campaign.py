import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails
from tests.campaign.sizes import REFINEMENT

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([0.1, 1.0, 3.0])
OPTIONS = CampaignOptions(
    num_simulations=600,
    num_samples=100,
    details=CampaignDetails(num_scored=200),
    density_estimator=MixtureDensity(
        hidden_features=(32,), num_components=2, num_iterations=400, learning_rate=3e-3
    ),
    refinement=REFINEMENT,
)


def simulator(theta, action):
    return theta * action + 0.1 * torch.randn_like(theta)


def campaign(**changes):
    arguments = {"options": OPTIONS} | changes
    return Campaign(simulator, PRIOR, ACTIONS, **arguments)


def test_ask_tell_update():
    c = campaign()
    trial = c.ask()
    assert trial.status == "pending"
    assert trial.action.tolist() == [3.0]
    assert c.ask() is trial  # a pending trial is given again
    assert c.belief is PRIOR
    told = c.tell(torch.tensor([1.5]))
    assert told.status == "ok"
    assert told.x.tolist() == [1.5]
    assert c.belief is PRIOR  # tell only records
    belief = c.update()
    assert c.belief is belief
    assert abs(float(belief.mean) - 0.5) < 0.1
    trial = c.history[0]
    assert trial.information_gained > 0.5
    stages = {"simulation", "training", "design", "scoring", "update"}
    assert {*trial.cpu_seconds} == stages
    spent = belief.diagnostics.num_simulations + OPTIONS.num_scored
    assert trial.num_simulations == 600 + trial.design.num_simulations + spent
    assert belief.label == "refined"


def test_three_rounds_narrow_the_belief():
    c = campaign()
    seen = []
    c.run(
        lambda action: 0.7 * action + 0.1 * torch.randn(1),
        num_rounds=3,
        on_round=seen.append,
    )
    assert [t.index for t in seen] == [0, 1, 2]
    assert len(c.history) == 3
    # Noise .1 over actions of at most 3, three times, and 1 % of the prior.
    draws = c.belief.sample((4_000,))
    assert float((draws - 0.7).abs().median()) < 0.1
    assert c.belief.diagnostics.num_simulations > 0


def test_without_refinement_beliefs_are_chained():
    c = campaign(options=replace(OPTIONS, refine=False, estimator="posterior"))
    c.run(lambda action: 0.7 * action, num_rounds=2)
    assert c.belief.label == "chained approximation"
    assert c.history[0].design.bound == "lower"


def test_the_faithful_setting_is_the_paper_s():
    options = CampaignOptions.faithful()
    network = options.density_estimator
    assert (network.num_iterations, network.batch_size) == (2_000, 50)
    assert (network.hidden_features, network.num_components) == ((128, 128), 5)
    assert options.num_samples // 2 == 1_000  # one half chooses: the paper's M
    assert not options.refine


def test_an_action_outside_the_space_is_used_with_a_warning():
    c = campaign(method="nsbi")
    c.ask()
    with pytest.warns(UserWarning, match="simulated where it was executed"):
        c.tell([0.35], action=[0.7])


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
def test_same_seed_same_campaign_whatever_the_global_generator(method):
    beliefs = []
    for state in (1, 2):
        torch.manual_seed(state)
        np.random.seed(state)
        c = campaign(method=method, seed=4)
        c.run(lambda action: 0.4 * action, num_rounds=2)
        beliefs.append((c.belief.mean, [t.action.item() for t in c.history]))
    assert torch.equal(beliefs[0][0], beliefs[1][0])
    assert beliefs[0][1] == beliefs[1][1]


def test_nsbi_draws_actions_at_random():
    chosen = {float(campaign(method="nsbi", seed=s).ask().action) for s in range(12)}
    assert len(chosen) == 3
    c = campaign(method="nsbi")
    c.run(lambda action: 0.4 * action, num_rounds=1)
    assert c.history[0].design.bound == "none"


def test_telling_is_idempotent_and_another_outcome_takes_its_place():
    c = campaign(method="nsbi")
    trial = c.ask()
    first = c.tell([1.0], trial=trial)
    assert c.tell([1.0], trial=trial) is first
    assert c.tell(1.0, trial=0) is first
    assert c.tell([2.0], trial=trial).x.tolist() == [2.0]
    assert len(c.history) == 1


def test_an_action_other_than_the_one_asked_for():
    c = campaign(method="nsbi")
    trial = c.ask()
    with pytest.warns(UserWarning, match="not in DiscreteActions"):
        told = c.tell([0.35], trial=trial, action=[0.7])
    assert told.action.tolist() == pytest.approx([0.7])
    assert abs(float(c.update().mean) - 0.5) < 0.15


def test_a_trial_that_was_not_asked_for():
    c = campaign(method="nsbi")
    told = c.tell(np.array([0.5]), action=np.array([1.0]))
    assert told.index == 0
    assert told.design is None
    c.update()
    assert c.state.processed == [0]


def test_several_trials_told_at_once_are_used_in_order():
    c = campaign(method="nsbi")
    for x in (0.5, 1.4):
        c.tell([x], action=[x / 0.5])
    c.update()
    assert c.state.processed == [0, 1]
    assert abs(float(c.belief.mean) - 0.5) < 0.1


def test_missing_trials_are_ignored():
    c = campaign(method="nsbi")
    c.ask()
    assert c.tell(status="missing").x is None
    assert c.update() is PRIOR
    assert c.ask().index == 1


def test_invalid_outcomes_are_information():
    def falls_off(theta, action):
        x = simulator(theta, action)
        return torch.where(theta > 0.7, torch.nan, x)

    c = Campaign(falls_off, PRIOR, ACTIONS, method="nsbi", options=OPTIONS)
    c.ask()
    assert c.tell(status="invalid").x.isnan().all()
    assert float(c.update().mean) > 0.7
    c.ask()
    assert c.tell([float("nan")]).status == "invalid"


def test_an_error_of_the_real_system_leaves_the_trial_pending():
    c = campaign(method="nsbi")

    def broken(action):
        raise RuntimeError("the gripper is stuck")

    with pytest.raises(RuntimeError, match="gripper"):
        c.run(broken, num_rounds=1)
    assert c.pending is not None
    c.run(lambda action: 0.4 * action, num_rounds=1)
    assert len(c.history) == 1


def test_an_error_while_designing_loses_nothing():
    def fails_now(theta, action):
        raise RuntimeError("out of licenses")

    c = campaign()
    c.tell([0.5], action=[1.0])
    c.simulator = fails_now
    with pytest.raises(RuntimeError, match="licenses"):
        c.ask()
    assert c.pending is None
    assert c.history[0].x.tolist() == [0.5]
    c.simulator = simulator
    assert c.ask().status == "pending"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"method": "abc"},
            "expected method to be one of 'asbi', 'nsbi', "
            "'alhi', 'nlhi', 'seqbed'; got 'abc'",
        ),
    ],
)
def test_unknown_method(changes, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        campaign(**changes)


def test_other_errors():
    with pytest.raises(ValueError, match="got identical x from two seeds"):
        Campaign(lambda t, a: t * a, PRIOR, ACTIONS)
    with pytest.raises(ValueError, match="expected num_simulations >= 100"):
        CampaignOptions(num_simulations=10)
    c = campaign()
    with pytest.raises(ValueError, match="expected a pending trial; got none"):
        c.tell([1.0])
    with pytest.raises(ValueError, match="expected the index of one of 0 trials"):
        c.tell([1.0], trial=3)
    with pytest.raises(ValueError, match="expected status 'ok', 'invalid' or"):
        c.tell([1.0], status="lost")
    c = campaign(method="nsbi")
    c.ask()
    with pytest.raises(ValueError, match="expected the outcome x; got None"):
        c.tell()
    with pytest.raises(ValueError, match=re.escape("expected x of shape (1,)")):
        c.tell([1.0, 2.0])
    with pytest.raises(ValueError, match="expected action of shape"):
        c.tell([1.0], action=[1.0, 2.0])
    assert c.pending is not None


def test_a_declared_noise_makes_a_deterministic_simulator_usable():
    model = SimulatorModel(lambda t, a: t * a, noise=GaussianNoise(0.1))
    c = Campaign(model, PRIOR, ACTIONS, options=OPTIONS)
    assert c.ask().action.tolist() == [3.0]


def test_repr_counts():
    c = campaign(method="nsbi")
    c.ask()
    assert repr(c) == "Campaign(nsbi, 0 trials, one pending)"
