"""What few simulations cost a belief, against what they do cost it."""

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
    estimate_noise,
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
    noise = estimate_noise(pairs[0], pairs[1], np.ones(q))
    fit = LocalRegression.fit(whole_space(DIM), z, x, noise=noise, num_trials=1)
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
