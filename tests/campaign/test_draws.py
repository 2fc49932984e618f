"""Draws of each belief along the way, and the names of parameters."""

import pickle
from dataclasses import replace

import pytest
import torch

from sbi_active import ASBI, Campaign, to_inference_data
from sbi_active.campaign.learning.draws import NUM_KEPT
from sbi_active.inference.beliefs.belief import names_of

from .storage.campaigns import ACTIONS, MODEL, OPTIONS, PRIOR, go_on, new, outcome


def told(num_trials, directory=None, **more):
    campaign = new(directory, simulator=MODEL, **more)
    go_on(campaign, num_trials)
    campaign.update()
    return campaign


def test_each_trial_leaves_draws_of_the_belief_after_it():
    campaign = told(1)
    first = campaign.belief
    go_on(campaign, 2)
    campaign.update()
    draws = campaign.state.draws
    assert [*draws] == [0, 1]
    for belief, kept in ((first, draws[0]), (campaign.belief, draws[1])):
        assert kept.shape == (NUM_KEPT, 2)
        sd = belief.variance.sqrt()
        gap = (kept.mean(0) - belief.mean) / sd
        assert (gap.abs() < 4 / NUM_KEPT**0.5).all()
        assert kept.std(0) == pytest.approx(sd, rel=0.25)


def test_a_trial_without_an_outcome_leaves_none():
    campaign = told(1)
    campaign.ask()
    campaign.tell(status="missing")
    campaign.update()
    assert campaign.state.processed == [0, 1]
    assert [*campaign.state.draws] == [0]


def test_draws_come_back_with_the_folder(tmp_path):
    campaign = told(2, tmp_path / "c")
    kept = campaign.state.draws
    campaign.close()
    again = Campaign.load(tmp_path / "c").state.draws
    assert [*again] == [*kept]
    assert all(torch.equal(again[i], kept[i]) for i in kept)


def test_what_is_computed_again_is_drawn_again():
    campaign = told(2)
    before = dict(campaign.state.draws)
    campaign.correct(0, outcome(campaign.history[0].action, 7))
    campaign.update()
    after = campaign.state.draws
    assert [*after] == [0, 1]
    assert not any(torch.equal(before[i], after[i]) for i in before)
    campaign.withdraw(1)
    campaign.update()
    assert [*campaign.state.draws] == [0]


def test_beliefs_know_their_parameters(tmp_path):
    campaign = told(1, tmp_path / "c")
    belief = campaign.belief
    assert belief.parameter_names == ("a", "b")
    assert "refined: a 0." in repr(belief)
    assert ", b 0." in repr(belief)
    data = to_inference_data(belief, num_samples=10)
    assert [*data.posterior.parameter.values] == ["a", "b"]
    assert pickle.loads(pickle.dumps(belief)).parameter_names == ("a", "b")
    campaign.close()
    read = Campaign.load(tmp_path / "c").belief
    assert read.parameter_names == ("a", "b")


def test_beliefs_without_names_are_as_before():
    campaign = new(simulator=lambda theta, action: MODEL(theta, action))
    go_on(campaign, 1)
    belief = campaign.update()
    assert belief.parameter_names is None
    assert "refined: 0." in repr(belief)
    assert names_of(belief, 2) == ["theta_1", "theta_2"]


def test_a_doubted_belief_keeps_the_names():
    campaign = told(1)
    campaign.ask()
    campaign.tell(torch.full((4,), 1e4))
    with pytest.warns(UserWarning, match="range of the simulations"):
        campaign.update()
    assert campaign.belief.diagnostics.trustworthy is False
    assert campaign.belief.parameter_names == ("a", "b")


def test_an_update_with_a_simulator_names_the_belief():
    inference = ASBI(PRIOR)
    action = torch.tensor([1.0])
    belief = inference.update(
        outcome(action, 0),
        action=action,
        simulator=MODEL,
        refinement=replace(OPTIONS.refinement),
        seed=0,
    )
    assert belief.parameter_names == ("a", "b")
    assert ACTIONS.names == ["speed"]
