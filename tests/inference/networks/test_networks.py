"""Networks: their frames, densities, and what they see of outcomes."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active.inference.networks.baseline import Baseline, local, upper_factor
from sbi_active.inference.networks.conditioning import Conditioning, Whitening
from sbi_active.inference.networks.mixture_density import (
    Adam,
    MixtureDensity,
    train_network,
)
from sbi_active.inference.networks.response import Response
from sbi_active.seeding import forked_generators
from sbi_active.tasks.numerical import NumericalTask
from tests import linear_gaussian


def numerical(n=2_000):
    generator = torch.Generator().manual_seed(0)
    theta = 10 * torch.rand(n, 2, generator=generator) - 5
    action = torch.randint(21, (n, 1), generator=generator) * 0.5 - 5
    x = NumericalTask(variant="square").simulator.mean(theta, action)
    x = x + torch.randn(n, 1, generator=generator)
    return theta, torch.cat([x, action], 1)


def shaken(net):
    """Far from the start, so that nothing is trivial."""
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.2)
    return net


# The baseline


def gaussian_world(n=2_000, seed=0):
    torch.manual_seed(seed)
    theta, action = torch.randn(n, 2), 4 * torch.rand(n, 1) - 2
    return theta, linear_gaussian.simulator(theta, action), action


def test_the_linear_baseline_is_the_exact_posterior_of_a_linear_world():
    theta, x, action = gaussian_world(5_000)
    scale = x.double().std(0)
    baseline = Baseline(theta.double(), x / scale, action.double(), kind="linear")
    theta, x, action = gaussian_world(5_000, seed=1)
    frames = baseline(x / scale, action.double())
    mean, variance = linear_gaussian.moments(x, action)
    covariance = torch.linalg.inv(frames.factor.mT @ frames.factor)[:, 0]
    assert ((frames.mean[:, 0] - mean) / variance.sqrt()).square().mean() < 0.01
    ratio = covariance.diagonal(dim1=1, dim2=2) / variance
    assert ratio.log().abs().mean() < 0.06
    # Kullback-Leibler divergence, an error of second order in both.
    log_q = frames.log_det - 0.5 * local(theta, frames).square().sum(-1)
    error = theta.double() - mean
    log_p = -0.5 * (error.square() / variance + variance.log()).sum(-1, keepdim=True)
    assert float((log_p - log_q).mean()) < 0.02


# In the network


@torch.no_grad()
def test_samples_have_the_density():
    """E_q[r / q] = 1 for any density r that q covers: Gaussians among the draws."""
    theta, condition = numerical()
    torch.manual_seed(1)
    settings = MixtureDensity(hidden_features=(16,))
    net = shaken(settings.build(theta, condition, action_dim=1))
    num = 100_000
    for row in condition[:4].split(1):
        draws = net.sample(torch.Size([num + 10_000]), row)[:, 0]
        log_q = net.log_prob(draws[:, None], row)[:, 0].double()
        few, likeliest_first = draws[num:].double(), log_q[num:].argsort().flip(0)
        for rank in (0, 3_000, 6_000):
            r = gaussian_around(few[likeliest_first[rank]], few)
            ratio = (r.log_prob(draws[:num].double()) - log_q[:num]).exp()
            error = float(ratio.std()) / math.sqrt(num)
            assert error < 0.1
            assert abs(float(ratio.mean()) - 1) < 4 * error


def gaussian_around(place, draws):
    """Return a Gaussian as wide as draws lie around a place, but narrower."""
    near = draws
    for _ in range(4):
        factor = torch.linalg.cholesky(torch.cov(near.T))
        z = torch.linalg.solve_triangular(factor, (near - place).mT, upper=False)
        near = near[z.square().sum(0).argsort()[: len(near) // 2]]
    covariance = 0.5 * torch.cov(near.T)
    return torch.distributions.MultivariateNormal(near.mean(0), covariance)


@pytest.mark.parametrize(
    ("theta", "x", "action"),
    [
        (torch.randn(100, 2), torch.full((100, 1), 3.0), torch.rand(100, 1)),
        (torch.randn(100, 2), torch.randn(100, 1), torch.full((100, 1), 2.0)),
        (torch.randn(1, 2), torch.randn(1, 1), torch.rand(1, 1)),
        (torch.ones(100, 2), torch.randn(100, 1), torch.rand(100, 1)),
        (torch.randn(200, 2), torch.full((200, 1), torch.nan), torch.rand(200, 1)),
    ],
    ids=["constant x", "constant action", "one row", "constant theta", "no numbers"],
)
def test_degenerate_rows(theta, x, action):
    condition = torch.cat([x, action], 1)
    net = MixtureDensity(hidden_features=(8,)).build(theta, condition, action.shape[1])
    assert net.log_prob(theta, condition).isfinite().all()
    assert net.sample(torch.Size([2]), condition).isfinite().all()
    if len(x) > 1 and x.isfinite().all():  # whatever is chosen
        own = Whitening(theta, full=True)(theta), x.double(), action.double()
        frames = Baseline(*own, kind="curved")(*own[1:])
        assert all(part.isfinite().all() for part in frames)


def test_factor_survives_rounding():
    generator = torch.Generator().manual_seed(0)
    size = 10.0 ** torch.linspace(0, 12, 50, dtype=torch.float64)[:, None, None]
    jacobian = size * torch.randn(50, 3, 2, dtype=torch.float64, generator=generator)
    eye = torch.eye(3, dtype=torch.float64)
    precision = eye + jacobian @ jacobian.mT
    lost = torch.linalg.cholesky_ex(precision)[1] > 0
    assert 5 < lost.sum() < 45  # a plain factorization raises
    factor = upper_factor(torch.cat([eye.expand(50, 3, 3), jacobian.mT], 1))
    assert (factor.diagonal(dim1=1, dim2=2) > 0.99).all()
    error = (factor.mT @ factor - precision).abs().amax((1, 2))
    assert (error / precision.abs().amax((1, 2))).max() < 1e-12


def test_beyond_twelve_parameters_draws_follow_the_density():
    """Factors of a component are its own there, and one solve serves its draws."""
    torch.manual_seed(0)
    dim, condition = 13, torch.randn(300, 4)
    settings = MixtureDensity(hidden_features=(8,), num_components=2)
    net = settings.build(torch.randn(300, dim), condition, 1)
    *_, last = net.net.children()
    assert last.out_features == 2 * (1 + 2 * dim)
    own = dict(net.named_parameters())
    for name in ("_upper", "net.2.bias"):
        torch.nn.init.normal_(own[name], 0.0, 0.3)
    row = condition[:1]
    with torch.no_grad():
        drawn = net.sample(torch.Size([20_000]), row)[:, 0]
        log_q = net.log_prob(drawn[:, None], row)[:, 0].double()
    # Under q the mean of f / q is the integral of any density f.
    normal = torch.distributions.MultivariateNormal(drawn.mean(0), drawn.T.cov() / 2)
    ratio = (normal.log_prob(drawn).double() - log_q).exp()
    assert abs(float(ratio.mean()) - 1) < 5 * float(ratio.std()) / 20_000**0.5 < 0.2


# Location and scale of outcomes given the action


def test_isolated_actions_leave_a_finite_noise():
    g = torch.Generator().manual_seed(1)
    action = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]).repeat(100)
    # A few rows far from the others: between, the noise's polynomial is free to dive.
    far = torch.tensor([3.5, 3.5, 3.5, 5.5, 10.0])
    action = torch.cat([action, far])[:, None].double()
    u = torch.randn(len(action), 3, generator=g, dtype=torch.float64)
    e = torch.randn(len(action), 3, generator=g, dtype=torch.float64)
    moved = (action - 1.5).clamp_min(0.0)  # slow ones move nothing
    x = moved * (1 + 0.3 * u[:, :1] + 0.1 * u[:, 1:2] ** 2) + 0.005 * e[:, :1]
    y = torch.cat([x, e[:, 1:]], 1)
    y = (y - y.mean(0)) / y.std(0)
    response = Response(u, y, action, kind="linear")
    assert float(response.log_low.min()) > -20
    everywhere = torch.linspace(0.0, 10.0, 101, dtype=torch.float64)[:, None]
    assert all(part.isfinite().all() for part in response.weights(everywhere))
    frames = Baseline(u, y, action, kind="linear")(y, action)
    assert all(part.isfinite().all() for part in frames)


# Outcomes with many numbers, of which a network sees a few directions


NUM, SD = 300, 2.0
TIMES = torch.linspace(0.1, 1.0, NUM)
BASIS = torch.stack([TIMES, torch.sin(8 * TIMES)])


def rows(num: int, seed: int):
    with forked_generators(seed):
        theta, action = torch.randn(num, 2), 0.5 + torch.rand(num, 1)
        x = action * (theta @ BASIS) + SD * torch.randn(num, NUM)
    return theta, torch.cat([x, action], 1)


def exact(theta, condition):
    x, action = condition.double().split([NUM, 1], 1)
    slope = action[:, :, None] * BASIS.double().T / SD
    precision = torch.eye(2).double() + slope.mT @ slope
    pull = slope.mT @ (x / SD)[..., None]
    mean = torch.linalg.solve(precision, pull)[..., 0]
    own = MultivariateNormal(mean, precision_matrix=precision)
    return own.log_prob(theta.double()).mean()


def test_a_network_of_many_numbers_comes_near_the_exact_posterior():
    theta, condition = rows(4_000, 0)
    with forked_generators(1):
        network = MixtureDensity().build(theta, condition, 1)
        steps = Adam(network.parameters(), rate=1.5e-2)
        fitted, held_out = torch.arange(4_000).split([3_600, 400])
        given = {"train_rows": fitted, "held_out_rows": held_out}
        given |= {"num_iterations": 160, "batch_size": 200, "anneal": True}
        data, loss = network.prepare(theta, condition), network.prepared_loss
        train_network(network, steps, loss, data, **given)
    assert network.conditioning.baseline.kind == "linear"
    theta, condition = rows(2_000, 2)
    with torch.no_grad():
        score = network.log_prob(theta[None], condition).mean()
    assert exact(theta, condition) - score < 0.15


def test_an_outcome_that_lacks_a_number_is_seen_by_the_others():
    theta, condition = rows(300, 0)
    whole = condition.clone()
    condition[5, :NUM], condition[9, 4] = torch.nan, torch.nan
    own = Conditioning(theta, condition, 1, whiten=True, adapts=True)
    assert own.num_frames == 2
    seen, frames = own(condition)
    before, _ = own(whole)
    assert bool(seen.isfinite().all())
    directions = slice(0, 32)
    assert bool((seen[5, directions] == 0).all())  # nothing was measured
    apart = (seen[9] - before[9])[directions].norm()
    assert float(apart) < 0.2 * float(before[9, directions].norm())
    # No frame is trusted where a number lacks.
    for row in (5, 9):
        assert bool((frames.mean[row] == 0).all())
