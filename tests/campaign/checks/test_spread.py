"""Shrunk covariances against leave-one-out likelihoods that are computed one by one."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active.campaign.checks.spread import SHARES, Spread


def rows(num, dim, seed=0):
    generator = torch.Generator().manual_seed(seed)
    factor = torch.randn(dim, dim, generator=generator).double()
    return 7 + torch.randn(num, dim, generator=generator).double() @ factor


def left_out_score(z, share):
    """Return the mean log likelihood of each row under the others' covariance."""
    n, total = len(z), 0.0
    for i in range(n):
        rest = torch.cat([z[:i], z[i + 1 :]])
        covariance = (1 - share) * rest.T @ rest / (n - 1)
        # The diagonal is that of all rows, which are standardized.
        covariance = covariance + share * torch.eye(z.shape[1]).double()
        normal = MultivariateNormal(torch.zeros(z.shape[1]).double(), covariance)
        total += float(normal.log_prob(z[i]))
    return total / n


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("num", "dim"), [(40, 3), (12, 5), (6, 3)])
def test_the_share_is_that_of_the_largest_left_out_likelihood(num, dim, seed):
    x = rows(num, dim, seed)
    spread = Spread.of(x)
    z = (x - x.mean(0)) / x.std(0, correction=0)
    assert torch.allclose(spread.z, z)
    best = max(SHARES.tolist(), key=lambda share: left_out_score(z, share))
    assert spread.share == best


@pytest.mark.parametrize(("num", "dim"), [(40, 3), (6, 10)])
def test_distances_and_the_root_belong_to_one_covariance(num, dim):
    x = rows(num, dim)
    spread = Spread.of(x)
    gap = x - x.mean(0)
    sample = gap.T @ gap / num
    mixed = (1 - spread.share) * sample + spread.share * sample.diagonal().diag()
    root = spread.root()
    assert torch.allclose(root @ root.T, mixed, rtol=1e-6)
    expected = (gap * torch.linalg.solve(mixed, gap.T).T).sum(1)
    assert torch.allclose(spread.distance, expected, rtol=1e-5)


def test_order_and_what_was_not_measured():
    x = rows(20, 4)
    x[3, 1] = x[5] = torch.nan
    spread, turned = Spread.of(x), Spread.of(x.flip(0))
    assert torch.allclose(spread.mean, x.nanmean(0))
    assert torch.allclose(turned.distance.flip(0), spread.distance)
    assert turned.share == spread.share
    assert (spread.z[5] == 0).all()
    assert spread.distance[5] == 0


def test_numbers_that_never_vary_do_no_harm():
    x = rows(30, 3)
    spread = Spread.of(torch.cat([x, torch.full((30, 1), 4.0).double()], 1))
    assert (spread.z[:, 3] == 0).all()
    assert spread.distance.isfinite().all()
    assert spread.root().isfinite().all()
