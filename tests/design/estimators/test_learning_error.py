"""The error of learning, against derivatives of the linear world's information."""

import math

import pytest
import torch

from sbi_active.design.estimators.nested import learning_error

N, SLOPE = 5_000, 1.7


def world():
    """Return slopes, coordinates, differences and residuals of x = SLOPE z + e."""
    generator = torch.Generator().manual_seed(0)
    z = 0.8 * torch.randn(N, 1, generator=generator).double()
    slope = torch.full((N, 1, 1), SLOPE).double()
    difference, residual = torch.randn(2, N, 1, generator=generator).double()
    return slope, z, difference, residual


def information(variance, noise):
    return 0.5 * math.log1p(SLOPE**2 * variance / noise)


def test_noise_counts_by_the_derivative_of_the_information():
    slope, z, difference, residual = world()
    effect = learning_error(slope, z, difference, 0 * residual, torch.ones(N).double())
    variance = float(z.var())
    step = 1e-4
    rise = information(variance, 1 + step) - information(variance, 1 - step)
    exact = rise / (2 * step) * (difference[:, 0] ** 2 - 1)
    assert torch.allclose(effect, exact - exact.mean(), atol=1e-6)


def test_the_mean_counts_by_what_the_posterior_leaves_of_it():
    slope, z, difference, residual = world()
    effect = learning_error(slope, z, 0 * difference, residual, torch.ones(N).double())
    left = z - z.mean()  # E[f - E[f | x]] is this share of the slope's
    exact = (SLOPE * left / (1 + SLOPE**2 * z.var()) * residual)[:, 0]
    assert torch.allclose(effect, exact - exact.mean(), atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_incomplete_pairs_say_nothing_of_the_noise(share):
    slope, z, difference, residual = world()
    complete = (torch.arange(N) % 2 == 0).double()
    shares = torch.where(complete == 1, 1.0, share).double()
    effect = learning_error(
        slope, z, difference * complete[:, None], 0 * residual, shares
    )
    ratio = SLOPE**2 * z.var()
    weight = -0.5 * ratio / (1 + ratio) * shares.mean() / complete.mean()
    exact = weight * complete * (difference[:, 0] ** 2 - 1)
    assert torch.allclose(effect, exact - exact.mean(), atol=1e-6)
