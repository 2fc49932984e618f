"""Fresh simulations tell a belief that is right from one that is not."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_active.inference.refinement.confirmation import by_likelihoods


class Normal:
    """A belief over two coordinates with the likelihood that led to it."""

    def __init__(self, mean, sd):
        self.mean, self.sd = torch.tensor(mean).float(), torch.tensor(sd).float()

    def sample(self, shape):
        return self.mean + self.sd * torch.randn(*shape, 2)

    def log_likelihood(self, z):
        return log_normal(z, self.mean.double().numpy(), self.sd.double().numpy())


def log_normal(z, mean, sd):
    return -0.5 * (((z - mean) / sd) ** 2).sum(1) - np.log(sd).sum()


class Likelihood:
    """The exact likelihood: a standard normal."""

    class table:  # noqa: N801
        num_simulations = 7

    def __call__(self, theta: Tensor):
        return log_normal(theta.double().numpy(), np.zeros(2), np.ones(2))


class Stages:
    class settings:  # noqa: N801
        checked_share, num_histories = 0.5, 4_000
        largest_divergence, largest_shift = 0.1, 0.3

    class coordinates:  # noqa: N801
        @staticmethod
        def to_z(theta):
            return theta.double().numpy()


@pytest.mark.parametrize(
    ("mean", "sd", "kl", "rel", "holds"),
    [
        ([0.0, 0.0], [1.0, 1.0], 0.0, 0.15, True),
        ([0.1, 0.0], [1.0, 1.0], 0.005, 0.15, True),
        ([0.6, 0.0], [1.0, 1.0], 0.18, 0.15, False),
        ([0.0, 0.0], [0.5, 0.5], 0.636, 0.6, False),
        ([0.5, 0.5], [0.8, 0.8], 0.336, 0.15, False),
    ],
)
def test_divergence_of_normal_beliefs_is_the_exact_one(mean, sd, kl, rel, holds):
    found = by_likelihoods(
        Stages(), Normal(mean, sd), Likelihood(), np.random.default_rng(0)
    )
    # Of 1,000 draws; the weights of a belief that is half as wide have no variance.
    assert found.divergence == pytest.approx(kl, rel=rel, abs=0.005)
    assert found.holds is holds
    assert found.num_simulations == 7


def test_a_likelihood_that_is_nowhere_finite_confirms_nothing():
    class Nowhere(Likelihood):
        def __call__(self, theta):
            return np.full(len(theta), -np.inf)

    found = by_likelihoods(
        Stages(), Normal([0.0, 0.0], [1.0, 1.0]), Nowhere(), np.random.default_rng(0)
    )
    assert not found.holds
    assert found.shift == np.inf
