"""Pyro models as simulators, and beliefs as Pyro distributions."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from sbi_active import MixtureDensity
from sbi_active.inference import refine
from sbi_active.pyro import RobustASBI, from_pyro
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, StudentTNoise


def growth(action: Tensor) -> Tensor:
    """Return a population after a time, its log read."""
    rate = pyro.sample("rate", dist.LogNormal(-1.0, 0.4))
    start = pyro.sample("start", dist.Normal(0.0, 1.0))
    return pyro.sample("x", dist.Normal(start + rate * action, 0.2).to_event(1))


def dose(action: Tensor) -> Tensor:
    """Return the responders among 20 at a dose."""
    at = pyro.sample("threshold", dist.Uniform(-2.0, 2.0))
    slope = pyro.sample("slope", dist.LogNormal(1.0, 0.3))
    share = torch.sigmoid(slope * (action - at))
    return pyro.sample("x", dist.Binomial(20, share).to_event(1))


def line(action: Tensor) -> Tensor:
    """Return a line read by a sensor of heavy tails."""
    w = pyro.sample("w", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
    reading = dist.StudentT(4.0, w[0] + w[1] * action, 0.1)
    return pyro.sample("x", reading.to_event(1))


def test_names_supports_and_noise():
    problem = from_pyro(growth, torch.ones(1))
    assert problem.parameter_names == ["rate", "start"]
    assert isinstance(problem.simulator.noise, GaussianNoise)
    assert float(problem.simulator.noise.sd.max()) == pytest.approx(0.2)
    assert problem.prior.support.check(
        torch.tensor([[1.0, -5.0], [-1.0, 0.0]])
    ).tolist() == [True, False]
    theta = torch.tensor([[0.5, 1.0]])
    exact = dist.LogNormal(-1.0, 0.4).log_prob(torch.tensor(0.5)) + dist.Normal(
        0.0, 1.0
    ).log_prob(torch.tensor(1.0))
    assert float(problem.prior.log_prob(theta)) == pytest.approx(float(exact))
    mean = problem.simulator.mean(theta, torch.tensor([[3.0]]))
    assert float(mean) == pytest.approx(2.5)


def test_other_likelihoods():
    noise = from_pyro(line, torch.ones(1)).simulator.noise
    assert isinstance(noise, StudentTNoise)
    assert float(noise.sd.max()) == pytest.approx(0.1 * math.sqrt(2))
    drawn = from_pyro(dose, torch.ones(1)).simulator
    assert drawn.noise is None
    theta, action = torch.tensor([[0.0, 2.0]]).expand(200, -1), torch.ones(200, 1)
    with forked_generators(0):
        x = drawn(theta, action)
    assert float(x.mean()) == pytest.approx(20 / (1 + math.exp(-2)), abs=0.4)


def test_a_belief_is_the_prior_of_the_next_model():
    problem = from_pyro(growth, torch.ones(1))
    action, x = torch.tensor([[1.0], [4.0]]), torch.tensor([[0.6], [1.5]])

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta[:, 1:] + theta[:, :1] * action + 0.2 * torch.randn(len(theta), 1)

    belief = refine(simulator, problem.prior, action, x, seed=0)
    prior = belief.to_pyro()
    with forked_generators(0):
        trace = pyro.poutine.trace(lambda: pyro.sample("theta", prior)).get_trace()
    theta = trace.nodes["theta"]["value"]
    assert theta.shape == (2,)
    assert torch.allclose(trace.log_prob_sum(), belief.log_prob(theta))
    assert prior.expand([3]).sample().shape == (3, 2)


def test_models_that_cannot_be_used():
    def nested(action: Tensor) -> Tensor:
        at = pyro.sample("at", dist.Normal(0.0, 1.0))
        b = pyro.sample("b", dist.Normal(at, 1.0))
        return pyro.sample("x", dist.Normal(b * action, 1.0).to_event(1))

    def counted(action: Tensor) -> Tensor:
        n = pyro.sample("n", dist.Poisson(3.0))
        return pyro.sample("x", dist.Normal(n * action, 1.0).to_event(1))

    with pytest.raises(ValueError, match="depend on nothing; got 'b'"):
        from_pyro(nested, torch.ones(1))
    with pytest.raises(ValueError, match="discrete"):
        from_pyro(counted, torch.ones(1))
    with pytest.raises(ValueError, match="name the outcome"):
        from_pyro(growth, torch.ones(1), outcome="y")


@pytest.mark.slow
@pytest.mark.parametrize(
    "x", [[0.3, 0.3], [1e3, -1e3], [0.3, math.nan], [math.nan, math.nan]]
)
def test_a_first_trial_of_any_kind_leaves_a_belief(x):
    """Right, wrong in every channel, a dead sensor, and no outcome at all."""

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        mean = theta * action
        return mean.expand(-1, 2) + 0.1 * torch.randn(len(theta), 2)

    prior = dist.Uniform(-torch.ones(1), torch.ones(1)).to_event(1)
    inference = RobustASBI(prior, MixtureDensity(num_iterations=300))
    with forked_generators(0):
        theta, action = prior.sample((2_000,)), torch.rand(2_000, 1)
        rows = simulator(theta, action)
        inference.append_simulations(theta, rows, action=action).train()
    belief = inference.update(
        torch.tensor(x), action=torch.ones(1), simulator=simulator, seed=0
    )
    draws = belief.sample((1_000,))
    probability = inference.denoised[-1].probability.nan_to_num(0.0)
    if x[0] == 0.3:
        assert float(draws.mean()) == pytest.approx(0.3, abs=0.1)
        assert bool((probability < 0.2).all())
    else:
        assert float(draws.std()) > 0.4  # the prior's is .58
    if x[0] == 1e3:
        assert bool((probability > 0.99).all())
