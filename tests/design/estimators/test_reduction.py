"""Long outcomes keep what predicts the target."""

import pytest
import torch

from sbi_active.design.estimators.densities import Reduction


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def test_few_numbers_are_standardized_and_kept():
    x = 5 + normal(300, 4) * torch.tensor([1e-6, 1.0, 1e6, 0.0]).double()
    reduce = Reduction.fit(x, normal(300, 2, seed=1))
    z = reduce(x)
    assert z.shape == (300, 4)
    expected = (x[:, :3] - x[:, :3].mean(0)) / x[:, :3].std(0)
    assert torch.allclose(z[:, :3], expected)
    assert (z[:, 3] == 0).all()  # never varies
    assert float(reduce(1e9 + x)[:, :2].max()) == 8.0


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
