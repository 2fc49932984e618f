"""Local regressions, and what few simulations cost a belief."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active.inference.refinement.checks import expected_error
from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.regions import whole_space
from sbi_active.inference.regression.surrogate import (
    LocalRegression,
    Surrogate,
    noise_variance,
)
from sbi_active.inference.sampling.coordinates import PriorCoordinates

DIM = 3
PRIOR = MultivariateNormal(torch.zeros(DIM), torch.eye(DIM))


def surrogate_of(q: int, num: int, seed: int):
    """Return the surrogate of x = A z + e at x = 0, and the exact precision."""
    rng = np.random.default_rng(seed)
    coordinates = PriorCoordinates(PRIOR, np.random.default_rng(0))
    weight = np.random.default_rng(q).standard_normal((DIM, q))
    z = coordinates.sample_prior(num, rng)
    x = z @ weight + rng.standard_normal((num, q))
    pairs = rng.standard_normal((2, 100, q))
    noise = noise_variance(pairs[0], pairs[1], np.ones(q))
    fit = LocalRegression.fit(
        whole_space(DIM), z, x, noise=noise, num_pairs=len(pairs[0]), num_trials=1
    )
    precision = weight @ weight.T + np.diag(coordinates._scale**2)
    return Surrogate(coordinates, [fit]), precision


@pytest.mark.parametrize(("q", "num"), [(4, 100), (60, 300)])
def test_expected_error_is_the_mean_divergence(q: int, num: int):
    expected, actual = [], []
    for seed in range(20):
        surrogate, precision = surrogate_of(q, num, seed)
        rng = np.random.default_rng(1_000 + seed)
        factor = np.linalg.cholesky(np.linalg.inv(precision))
        draws = rng.standard_normal((2_000, DIM)) @ factor.T
        expected.append(expected_error(surrogate, draws, rng))
        # KL(exact || belief), the normalizer by importance sampling from the exact.
        log_joint = surrogate.coordinates.log_prior(draws)
        log_joint = log_joint + surrogate.log_likelihood(draws)
        ratio = log_joint + 0.5 * ((draws @ precision) * draws).sum(1)
        top = ratio.max()
        actual.append(np.log(np.exp(ratio - top).mean()) + top - ratio.mean())
    error = np.std(actual) / len(actual) ** 0.5
    assert np.mean(expected) == pytest.approx(np.mean(actual), rel=0.2, abs=3 * error)


def histories_of(curve) -> Histories:
    """Return histories over the prior and near the truth, and twenty numbers each."""
    rng = np.random.default_rng(0)
    coordinates = PriorCoordinates(PRIOR, rng)
    weight = torch.from_numpy(rng.standard_normal((DIM, 20))).float()

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return curve(theta) @ weight + 0.3 * torch.randn(len(theta), 20)

    x = curve(torch.full((1, DIM), 0.2)) @ weight
    histories = Histories(
        simulator, torch.zeros(1, 1), x.double().numpy(), coordinates, 0
    )
    histories.add(coordinates.sample_prior(400, rng), 60, is_overview=True)
    near = coordinates.to_z(torch.full((1, DIM), 0.2))
    histories.add(near + 0.05 * rng.standard_normal((150, DIM)), 30)
    return histories


def test_histories_that_are_taken_over_keep_their_repetitions():
    """They tell the noise: without any nothing could be regressed."""
    histories = histories_of(lambda theta: theta)
    past = histories.record()
    again = Histories(
        histories.simulator,
        torch.zeros(2, 1),
        np.zeros((2, 20)),
        histories.coordinates,
        1,
        past,
    )
    region = whole_space(DIM)
    assert again.reuse(region, 120, is_overview=True) == 120
    assert len(again.pairs[0]) == 60  # of the overview, the first 60 are repeated
    assert again.reuse(region, 100, is_overview=True) == 100
    assert len(again.pairs[0]) == 60


# Local regressions: density, misfit against noise, shrinkage


NUM = 400


def regress(curve, *, noise: float = 0.1, q: int = 3, num_trials: int = 1):
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (NUM, 2))
    weight = rng.standard_normal((2, q))
    x = curve(z) @ weight + noise * rng.standard_normal((NUM, q))
    pairs = noise * rng.standard_normal((2, 80, q))
    estimate = noise_variance(pairs[0], pairs[1], np.ones(q))
    fit = LocalRegression.fit(
        whole_space(2), z, x, noise=estimate, num_pairs=80, num_trials=num_trials
    )
    return fit, weight


@pytest.mark.parametrize("q", [1, 3, 12])
def test_likelihood_of_a_linear_model(q: int):
    fit, weight = regress(lambda z: z, q=q)
    z = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2)) * 0.1
    # The observation is the origin, since outcomes are given less the observed ones.
    square = ((z @ weight) ** 2).sum(1) / 0.1**2
    exact = -0.5 * square - 0.5 * q * np.log(2 * np.pi * 0.1**2)
    # q variances, each from some 400 residuals, and 3 coefficients a outcome.
    error = np.sqrt(q / 2 / NUM) + np.sqrt(3 * square.max() / NUM)
    assert abs(fit.log_likelihood(z) - exact).max() < 4 * error
    assert not fit.has_misfit
    assert fit.caution() == 1


def test_misfit_is_told_from_noise():
    # No polynomial or smooth wave follows a step.
    fit, _ = regress(lambda z: np.sign(z - 0.1))
    assert fit.has_misfit
    assert fit.ratio > 3
    assert fit.caution() >= 2
