"""Pyro models as simulators, the error model, and draws of denoised outcomes."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, StudentT

from sbi_active import MixtureDensity
from sbi_active.inference import refine
from sbi_active.pyro import RobustASBI, SpikeAndSlab, from_pyro
from sbi_active.pyro.denoising import Predictive, denoise, swept
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
    inside = problem.prior.support.check(torch.tensor([[1.0, -5.0], [-1.0, 0.0]]))
    assert inside.tolist() == [True, False]
    theta = torch.tensor([[0.5, 1.0]])
    parts = dist.LogNormal(-1.0, 0.4), dist.Normal(0.0, 1.0)
    exact = sum(p.log_prob(v) for p, v in zip(parts, theta[0], strict=True))
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
    told = {"action": torch.ones(1), "simulator": simulator, "seed": 0}
    belief = inference.update(torch.tensor(x), **told)
    draws = belief.sample((1_000,))
    probability = inference.denoised[-1].probability.nan_to_num(0.0)
    if x[0] == 0.3:
        assert float(draws.mean()) == pytest.approx(0.3, abs=0.1)
        assert bool((probability < 0.2).all())
    else:
        assert float(draws.std()) > 0.4  # the prior's is .58
    if x[0] == 1e3:
        assert bool((probability > 0.99).all())


# The error model, and denoised outcomes


SPIKES = SpikeAndSlab()


def predictive(*shape, correlation=0.0):
    with forked_generators(0):
        draws = torch.randn(*shape)
    cov = torch.full((shape[1], shape[1]), correlation).fill_diagonal_(1.0)
    return draws @ torch.linalg.cholesky(cov).T


@pytest.mark.slow
def test_a_gross_channel_is_told_and_goes_back_to_the_predictive():
    x_o = torch.tensor([3.0, 500.0])
    found = denoise(x_o, 2.0 + 3.0 * predictive(1_000, 2), SPIKES, seed=0)
    assert found.probability[0] < 0.1
    assert found.probability[1] > 0.99
    assert float(found.x[:, 0].median()) == pytest.approx(3.0, abs=0.1)
    assert float(found.x[:, 1].mean()) == pytest.approx(2.0, abs=0.8)
    assert float(found.x[:, 1].std()) == pytest.approx(3.0, rel=0.25)
    assert found.r_hat < 1.1


@pytest.mark.slow
def test_a_channel_that_was_not_observed_follows_the_others():
    draws = predictive(1_000, 2, correlation=0.99)
    found = denoise(torch.tensor([1.5, torch.nan]), draws, SPIKES, seed=0)
    kept = found.x[(found.x[:, 0] - 1.5).abs() < 0.1]
    assert len(kept) > 200
    assert float(kept[:, 1].mean()) == pytest.approx(1.5, abs=0.1)
    assert float(kept[:, 1].std()) == pytest.approx((1 - 0.99**2) ** 0.5, rel=0.3)
    assert found.probability.isnan().tolist() == [False, True]


def test_errors_count_by_their_size():
    x = torch.zeros(1, 2)
    probability = SPIKES.misspecified(x, torch.tensor([0.0, 50.0]))
    assert probability[0, 0] < 0.05
    assert probability[0, 1] > 0.95


def test_deviations_give_the_errors_of_the_program():
    """The normal errors of all deviations, summed, are the density of an outcome."""
    log_sd = torch.linspace(-12.0, 12.0, 20_001).double()
    step = log_sd[1] - log_sd[0]
    weight = SPIKES.log_deviation(log_sd).exp() * step
    assert float(weight.sum()) == pytest.approx(1.0, abs=1e-3)
    errors = torch.tensor([0.0, 0.004, 1.0, 30.0]).double()
    summed = (Normal(0.0, log_sd.exp()).log_prob(errors[:, None]).exp() * weight).sum(1)
    exact = 0.9 * Normal(0.0, SPIKES.spike).log_prob(errors).exp()
    exact = exact + 0.1 * StudentT(3.0, 0.0, SPIKES.slab).log_prob(errors).exp()
    # A known deviation is rounded by a tenth, which tells in the tails of a normal.
    assert summed[:3].tolist() == pytest.approx(exact[:3].tolist(), rel=0.03)
    assert summed[3] >= 0.97 * exact[3]


COV = torch.tensor([[1.0, 0.95], [0.95, 1.0]], dtype=torch.float64)
TWO = Predictive(
    torch.tensor([0.5, 0.5], dtype=torch.float64).log(),
    torch.tensor([[0.0, 0.0], [0.5, 0.0]], dtype=torch.float64),
    COV.expand(2, 2, 2),
)


@pytest.mark.parametrize("x", [[0.3], [6.0], [0.4, 2.9], [0.4, 0.3]])
def test_sweeps_draw_the_deviations_of_each_channel(x):
    """Beside sums over a grid: right or wrong, and how far."""
    target = torch.tensor(x, dtype=torch.float64)
    fit = TWO.marginal(torch.arange(2) < len(target))
    drawn = swept(fit, target, SPIKES, np.random.default_rng(0), 2_000).log()
    grid = torch.linspace(-9.2, 4.8, 400, dtype=torch.float64)
    pairs = torch.cartesian_prod(*[grid] * len(target)).reshape(-1, len(target))
    log_p = fit.log_joint(target, pairs.exp()).logsumexp(-1)
    log_p = log_p + SPIKES.log_deviation(pairs).sum(-1)
    p = log_p.softmax(0)
    for edge in (-3.0, 1.0, 2.5):
        exact = (p[:, None] * (pairs < edge)).sum(0)
        found = (drawn < edge).double().mean(0)
        assert torch.allclose(found, exact, atol=0.06), edge
