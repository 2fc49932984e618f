"""Potentials whose residuals are given as a function, under a standard normal prior."""

from types import SimpleNamespace

import numpy as np

from sbi_active.inference.engine import SimulatedPotential


class Given(SimulatedPotential):
    """Residuals in deviations of a Gaussian error.

    Args:
        function: From places (n, dim) to residuals (n, observed).
        dim: Number of coordinates.
        observed: Number of residuals.
        sd: Deviation of the error, for the likelihood's constant.
    """

    def __init__(self, function, dim, observed, *, sd=1.0):
        bound = np.full(dim, 8.0)
        self.coordinates = SimpleNamespace(
            dim=dim,
            precision=np.ones(dim),
            center=np.zeros(dim),
            low=-bound,
            high=bound,
            sample=lambda n, rng: rng.standard_normal((n, dim)),
        )
        self.dim, self.searched = dim, np.ones(dim, dtype=bool)
        self.function, self.num_observed, self.step = function, observed, 3e-3
        self.sd, self.num_trials, self.num_rows = sd, 1, 0

    @property
    def num_simulations(self):
        return self.num_rows

    def residual(self, u):
        self.num_rows += len(u)
        return (self.function(u),)

    def simulated(self, u):
        return u

    def log_prior(self, u):
        return -0.5 * (u**2).sum(1) - 0.5 * self.dim * np.log(2 * np.pi)

    def log_likelihood(self, u, *, floor=-np.inf, first=0, last=None):
        square = (self.residual(u)[0] ** 2).sum(1)
        return -0.5 * square - self.num_observed * np.log(self.sd * np.sqrt(2 * np.pi))

    def splits_off(self, axes, rng):
        return False
