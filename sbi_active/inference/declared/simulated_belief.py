"""The posterior under declared noise, by weighted draws and a simulated density."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.engine import Fit, SimulatedPotential
from sbi_active.inference.engine.pool import Pool
from sbi_active.inference.engine.potential import MeanTable
from sbi_active.inference.sampling.coordinates import NormalCoordinates
from sbi_active.inference.sampling.gaussian_mixture import GaussianMixture
from sbi_active.inference.sampling.student_mixture import NormalMixture
from sbi_active.inference.sampling.weights import systematic

BEYOND = 20.0  # nats below the defensive share at which a density is given up
NUM_FITTED = 1_000  # draws behind the smooth density


@dataclass(frozen=True)
class DeclaredRecord:
    """The record that a belief goes on from when a further trial is known.

    Attributes:
        trials: Actions and outcomes in the likelihood of the draws.
        coordinates: Coordinates that they are in.
        table: Noise-free outcomes so far.
        pool: The draws.
    """

    trials: tuple[Tensor, Tensor]
    coordinates: NormalCoordinates
    table: MeanTable
    pool: Pool

    def leads_to(self, simulator: Any, action: Tensor, x: Tensor) -> bool:
        """Return whether its trials are the first of these, of the same simulator."""
        t = len(self.trials[0])
        return (
            self.table.simulator is simulator
            and torch.equal(self.trials[0], action[:t])
            and torch.equal(self.trials[1].nan_to_num(), x[:t].nan_to_num())
            and torch.equal(self.trials[1].isnan(), x[:t].isnan())
        )


class SimulatedBelief(Belief):
    r"""The posterior of all trials, with the likelihood simulated and not learned.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)}{Z} \prod_k
        p\big(x_k \mid f(\theta, \xi_k)\big) + \epsilon\, p(\theta)

    Draws are resampled from the weighted ones of a fit, whose density costs nothing.
    Parameters that no trial informs, and that are independent of the others under the
    prior, are drawn from the prior afresh. ``log_prob`` elsewhere costs a simulation a
    trial and row; ``smooth_log_prob`` has a mixture fitted to the draws in place of the
    likelihood, and misses what the response does within its width.

    Args:
        prior: The original prior p.
        potential: Potential of all trials.
        fit: Weighted draws, and the evidence Z.
        defensive: The share :math:`\epsilon`.

    Attributes:
        histories: Histories that a refinement goes on from after a further trial.
        free: Parameters that keep their prior, shape (d,).
    """

    label = "refined"
    histories: DeclaredRecord

    def __init__(
        self,
        prior: Distribution,
        potential: SimulatedPotential,
        fit: Fit,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._likelihood, coordinates = potential.likelihood, potential.coordinates
        self._coordinates, rng = coordinates.base, np.random.default_rng(0)
        self._normal = NormalCoordinates(self._coordinates, rng, keeps_edges=False)
        self._defensive, self._log_evidence = defensive, fit.log_evidence
        self.free = fit.free
        self._z, self._weight = coordinates.to_z(fit.u), fit.weight
        u = self._normal.from_z(self._z[systematic(self._weight, NUM_FITTED, 0.5)])
        mixture = GaussianMixture.fit(u, 4, rng)
        self._fitted = NormalMixture(
            np.exp(mixture.log_weight), mixture.mean, mixture.factor
        )

    @property
    def log_evidence(self) -> float:
        """Log of the integral of prior times likelihood, nats."""
        return self._log_evidence

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        u = self._normal.from_z(z)
        log_volume = self._normal.log_slope(u) - self._coordinates.log_jacobian(z)
        log_prior = self._coordinates.log_prior(z) - self._coordinates.log_jacobian(z)
        density = np.logaddexp(
            np.log1p(-self._defensive) + self._fitted.log_prob(u) + log_volume,
            np.log(self._defensive) + log_prior,
        )
        return torch.from_numpy(density)

    def _log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        log_prior = self._coordinates.log_prior(z) - self._coordinates.log_jacobian(z)
        rows = np.isfinite(log_prior)
        floor = self._log_evidence + np.log(self._defensive) - BEYOND
        density = np.full(len(z), -np.inf)
        log_likelihood = self._likelihood(theta[torch.from_numpy(rows)], floor=floor)
        density[rows] = log_prior[rows] + np.logaddexp(
            np.log1p(-self._defensive) + log_likelihood - self._log_evidence,
            np.log(self._defensive),
        )
        return torch.from_numpy(density)

    def _sample(self, num_samples: int) -> Tensor:
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        num_prior = rng.binomial(num_samples, self._defensive)
        row = rng.choice(len(self._z), size=num_samples - num_prior, p=self._weight)
        prior = self._coordinates.sample_prior(num_prior, rng)
        z = rng.permutation(np.concatenate([self._z[row], prior]))
        theta = self._coordinates.to_theta(z)
        if self.free.any():
            fresh = self.prior.sample(torch.Size([num_samples])).to(theta)
            theta = torch.where(torch.from_numpy(self.free), fresh, theta)
        return theta
