"""When a round's network is trained, what asks it, and the posterior handed out."""

import pytest
import torch

from tests.campaign.problem import campaign, draws


def one_round(c):
    action = c.ask().action
    c.tell(0.7 * action)
    c.update()
    return c.history[-1]


def test_asking_for_the_posterior_trains_it_and_changes_nothing_else():
    asked, other = campaign("asbi"), campaign("asbi")
    ahead = asked.posterior  # before any trial
    assert other.ask().num_simulations == asked.ask().num_simulations
    state = torch.get_rng_state()
    posterior = asked.posterior
    assert torch.equal(torch.get_rng_state(), state)
    x, action = torch.tensor([1.5]), torch.tensor([3.0])
    for model in (ahead, posterior):
        samples = model.sample((2_000,), x=x, action=action)
        assert float(samples.mean()) == pytest.approx(0.5, abs=0.15)
    for c in (asked, other):
        c.tell(torch.tensor([2.1]))
        c.update()
    assert torch.equal(draws(asked), draws(other))
    assert asked.history[0].network_used_by == ("posterior",)
    assert other.history[0].network_used_by == ()


@pytest.mark.parametrize(
    ("changes", "asks"),
    [
        ({"estimator": "posterior"}, ("design",)),
        ({"refine": False}, ("belief",)),
    ],
)
def test_on_demand_it_is_trained_for_what_needs_it(changes, asks):
    trial = one_round(campaign("asbi", **changes))
    assert trial.network_used_by == asks
    assert "training" in trial.cpu_seconds
