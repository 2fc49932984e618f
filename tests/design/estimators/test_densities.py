"""Densities of classes and directions of outcomes against what they are drawn from."""

import math

import pytest
import torch

from sbi_active.design.estimators.densities import Reduction, class_members

ENOUGH = torch.tensor([True, True])


def drawn(*scales_and_means, n=4_000):
    """Return draws (k n, 1) of normal classes and their labels."""
    generator = torch.Generator().manual_seed(0)
    parts = [
        m + s * torch.randn(n, 1, generator=generator).double()
        for s, m in scales_and_means
    ]
    return torch.cat(parts), torch.arange(len(parts)).repeat_interleave(n)


def log_ratio(member, at):
    log_density = member(at)
    return log_density[:, 1] - log_density[:, 0]


def test_a_common_covariance_gives_the_linear_log_ratio():
    members = class_members(*drawn((1.0, -1.0), (1.0, 1.0)), ENOUGH)
    at = torch.linspace(-2, 2, 9).double()[:, None]
    assert (members[0](at) == 0).all()
    for member in members[1:3]:
        assert (log_ratio(member, at) - 2 * at[:, 0]).abs().max() < 0.2


def test_covariances_of_their_own_give_the_quadratic_log_ratio():
    members = class_members(*drawn((1.0, 0.0), (2.0, 0.0)), ENOUGH)
    at = torch.linspace(-3, 3, 9).double()[:, None]
    exact = 0.375 * at[:, 0] ** 2 - math.log(2)
    assert (log_ratio(members[2], at) - exact).abs().max() < 0.15
    assert log_ratio(members[1], at).abs().max() < 0.3  # sees no spread


def test_kernels_see_two_peaks_and_have_the_mass_of_the_others():
    one, _ = drawn((1.0, 0.0))
    two, _ = drawn((0.5, -3.0), (0.5, 3.0), n=2_000)
    x, label = torch.cat([one, two]), torch.arange(2).repeat_interleave(4_000)
    members = class_members(x, label, ENOUGH)
    at = torch.tensor([[0.0], [3.0]]).double()
    for member in members[3:]:
        between, peak = log_ratio(member, at).tolist()
        assert peak > 3
        assert between < -2
    grid = torch.linspace(-12, 12, 4_801).double()[:, None]
    masses = torch.stack([m(grid).exp().sum(0) for m in members[1:]])
    # Up to what is common to the classes, every density has the same mass.
    assert torch.allclose(masses[:, 0], masses[:, 1], rtol=0.01)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def share_left(z, target):
    """Return the share of the target's variance that no linear function of z has."""
    design = torch.cat([torch.ones(len(z), 1).double(), z], 1)
    left = target - design @ torch.linalg.lstsq(design, target).solution
    return float(left.var() / target.var())


@pytest.mark.parametrize("num", [1, 3])
def test_long_outcomes_keep_the_directions_of_the_target(num):
    x = normal(2_000, 40)
    x[:, :10] *= 30  # large, and nothing of the target's
    target = x[:, 20:].mean(1, keepdim=True) + normal(2_000, num, seed=1) * 1e-3
    x = 100 * x
    reduce = Reduction.fit(x, target)
    z = reduce(x)
    assert z.shape == (2_000, 6)
    assert torch.allclose(z.std(0), torch.ones(6).double(), atol=0.05)
    assert share_left(z, target[:, :1]) < 0.05
    # Without the target, its direction is one of forty.
    blind = Reduction.fit(x, normal(2_000, num, seed=2))
    assert share_left(blind(x), target[:, :1]) > 0.5
