"""When a round's network is trained, what asks it, and the posterior handed out."""

import time
from dataclasses import replace

import pytest
import torch

from sbi_active import Campaign, CampaignOptions, GaussianNoise, SimulatorModel
from sbi_active.campaign.learning.round_model import RoundModel
from sbi_active.seeding import forked_generators, row_normals
from tests.campaign.test_campaign import ACTIONS, OPTIONS, PRIOR

KNOWN = SimulatorModel(lambda t, a: t * a, noise=GaussianNoise(0.1))
ON_DEMAND = replace(OPTIONS, network="on demand")


def heavy_tailed(theta, action, *, seeds):
    """Return outcomes whose noise fails the test of normality."""
    return theta * action + 0.1 * row_normals(seeds, 1).float() ** 3


def campaign(simulator=KNOWN, **changes):
    options = replace(ON_DEMAND, **changes)
    method = "asbi"
    return Campaign(simulator, PRIOR, ACTIONS, method=method, options=options)


def draws(c):
    with forked_generators(0):
        return c.belief.sample((50,)).tolist()


def one_round(c):
    action = c.ask().action
    c.tell(0.7 * action)
    c.update()
    return c.history[-1]


def test_each_round_has_a_network_that_notes_and_diagnostics_ask():
    c = campaign(network="each round")
    trial = one_round(c)
    assert trial.network_used_by == ("notes", "start", "diagnostics")
    assert {"simulation", "training"} < {*trial.cpu_seconds}
    assert "chained_loss" in c.belief.diagnostics.figures


def test_on_demand_a_round_with_declared_noise_trains_none():
    c = campaign()
    for _ in range(2):
        trial = one_round(c)
        assert trial.network_used_by == ()
        assert {*trial.cpu_seconds} == {"design", "scoring", "update"}
        refined = c.belief.diagnostics["num_simulations"]
        spent = trial.design.num_simulations + OPTIONS.num_scored + refined
        assert trial.num_simulations == spent
    assert c.belief.label == "refined"
    # Noise .1 at the action 3, twice: deviation .024.
    assert float(c.belief.mean) == pytest.approx(0.7, abs=0.03)
    assert float(c.belief.variance.sqrt()) == pytest.approx(0.024, abs=0.008)


def test_asking_for_the_posterior_trains_it_and_changes_nothing_else():
    asked, other = campaign(), campaign()
    ahead = asked.posterior  # before any trial
    assert other.ask().num_simulations == asked.ask().num_simulations
    state = torch.get_rng_state()
    posterior = asked.posterior
    assert torch.equal(torch.get_rng_state(), state)
    x, action = torch.tensor([1.5]), torch.tensor([3.0])
    for model in (ahead, posterior):
        samples = model.sample((2_000,), x=x, action=action)
        assert float(samples.mean()) == pytest.approx(0.5, abs=0.05)
    for c in (asked, other):
        c.tell(torch.tensor([2.1]))
        c.update()
    assert draws(asked) == draws(other)
    assert asked.history[0].network_used_by == ("posterior",)
    assert other.history[0].network_used_by == ()
    # Under the belief after the trial, about .7 and narrow.
    samples = asked.posterior.sample((2_000,), x=x, action=action)
    assert float(samples.mean()) == pytest.approx(0.6, abs=0.1)


def test_the_posterior_of_a_round_is_trained_once():
    c = campaign(network="each round")
    c.posterior  # noqa: B018
    assert "training" not in c.ask().cpu_seconds
    assert c.ask().network_used_by == ("posterior", "notes")
    other = campaign(network="each round")
    one_round(other)
    c.tell(0.7 * c.ask().action)
    c.update()
    assert draws(c) == draws(other)


def test_a_campaign_resumes_from_its_trials():
    whole, told = campaign(), campaign()
    trial = one_round(whole)
    told.tell(trial.x, action=trial.action)
    told.update()
    assert draws(told) == draws(whole)
    assert told.ask().action.tolist() == whole.ask().action.tolist()


@pytest.mark.parametrize(
    ("changes", "asks"),
    [
        ({"estimator": "posterior"}, ("design",)),
        ({"refine": False}, ("belief",)),
        ({"refine": False, "estimator": "posterior"}, ("design", "belief")),
        ({"design_on": "training"}, ("design",)),
    ],
)
def test_on_demand_it_is_trained_for_what_needs_it(changes, asks):
    trial = one_round(campaign(**changes))
    assert trial.network_used_by == asks
    assert "training" in trial.cpu_seconds


def test_on_demand_it_is_trained_where_no_other_estimator_may_be_used():
    c = campaign(heavy_tailed)
    start = time.process_time()
    trial = c.ask()
    spent = time.process_time() - start
    assert trial.design.estimator == "PosteriorGain"
    assert trial.network_used_by == ("design",)
    assert sum(trial.cpu_seconds.values()) < spent  # each second on one account
    eager = campaign(heavy_tailed, network="each round").ask()
    gain = eager.design.expected_information_gain
    assert torch.equal(trial.design.expected_information_gain, gain)


@pytest.mark.parametrize("method", ["alhi", "seqbed"])
def test_other_methods_on_demand(method):
    options = CampaignOptions(
        **{"num_simulations": 600, "num_samples": 100, "num_scored": 200},
        density_estimator=None if method == "seqbed" else OPTIONS.density_estimator,
        refinement=replace(OPTIONS.refinement, num_histories=600),
        network="on demand",
    )
    c = Campaign(KNOWN, PRIOR, ACTIONS, method=method, options=options)
    trial = one_round(c)
    assert trial.network_used_by == ()
    assert float(c.belief.mean) == pytest.approx(0.7, abs=0.1)
    with pytest.raises(
        ValueError, match=f"whose network is a posterior; got '{method}"
    ):
        c.posterior  # noqa: B018


def test_a_model_is_trained_by_the_first_question():
    calls = []

    class Model:
        log_likelihood, belief = "density", "belief"

    def train():
        calls.append(1)
        return Model()

    model = RoundModel(train)
    assert getattr(model, "belief", None) is None
    assert not calls
    assert not hasattr(model, "log_posterior")
    assert not model.was_asked
    assert model.log_likelihood == "density"
    assert (model.was_asked, model.is_trained, calls) == (True, True, [1])


def test_unknown_words():
    with pytest.raises(
        ValueError, match="expected network 'each round' or 'on demand'"
    ):
        CampaignOptions(network="never")
