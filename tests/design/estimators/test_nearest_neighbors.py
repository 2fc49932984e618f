"""The entropy by nearest neighbors, where there is a formula for it."""

import math

import pytest
import torch

from sbi_active.design.estimators.entropy import nearest_neighbor_entropy


def gaussian(dim, *, num=2_000, seed=0):
    """Return correlated normal draws and their entropy, nats."""
    generator = torch.Generator().manual_seed(seed)
    factor = torch.eye(dim).double() + 0.9 * torch.ones(dim, dim).double().tril(-1)
    factor = 10.0 ** torch.arange(dim)[:, None].double() * factor
    x = torch.randn(num, dim, generator=generator).double() @ factor.T
    entropy = 0.5 * dim * math.log(2 * math.pi * math.e) + float(
        factor.diagonal().log().sum()
    )
    return x.float().double() + 3, entropy


@pytest.mark.parametrize(("dim", "k"), [(1, 1), (2, 4), (3, 4)])
def test_the_entropy_of_a_gaussian_of_any_units(dim, k):
    x, exact = gaussian(dim)
    each = nearest_neighbor_entropy(x, k)
    error = float(each.std()) / math.sqrt(len(x))
    assert error < 0.05
    assert float(each.mean()) == pytest.approx(exact, abs=4 * error)


def test_outcomes_that_are_the_same_have_the_entropy_of_their_rounding():
    x = torch.randn(200, 1, generator=torch.Generator().manual_seed(0)).double()
    repeated = x[:20].repeat(10, 1)
    each = nearest_neighbor_entropy(repeated, 3)
    assert each.isfinite().all()
    assert float(each.mean()) < -8
