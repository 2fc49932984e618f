"""The posterior under declared noise, by weighted draws and a simulated density."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.weighted import WeightedBelief
from sbi_active.inference.engine import Fit, SimulatedPotential
from sbi_active.inference.engine.pool import Pool
from sbi_active.inference.engine.potential import MeanTable
from sbi_active.inference.sampling.coordinates import NormalCoordinates
from sbi_active.inference.sampling.gaussian_mixture import fitted_normals
from sbi_active.inference.sampling.weights import systematic

Array = NDArray[Any]

BEYOND = 20.0  # nats below the defensive share at which a density is given up


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


class SimulatedBelief(WeightedBelief):
    r"""The posterior of all trials, with the likelihood simulated and not learned.

    .. math::
        L(\theta) = \prod_k p\big(x_k \mid f(\theta, \xi_k)\big)

    Parameters that no trial informs, and that are independent of the others under the
    prior, are drawn from the prior afresh. ``log_prob`` elsewhere costs a simulation a
    trial and row; ``smooth_log_prob`` has a mixture fitted to the draws in place of the
    likelihood, and misses what the response does within its width.

    Args:
        prior: The original prior.
        potential: Potential of all trials.
        fit: Weighted draws, and the evidence.
        defensive: Share of the prior.
        num_fitted: Number of draws behind the smooth density.

    Attributes:
        free: Parameters that keep their prior, shape (d,).
    """

    histories: DeclaredRecord

    def __init__(
        self,
        prior: Distribution,
        potential: SimulatedPotential,
        fit: Fit,
        *,
        defensive: float,
        num_fitted: int = 1_000,
    ) -> None:
        coordinates = potential.coordinates
        super().__init__(prior, coordinates.base, fit.log_evidence, defensive=defensive)
        self._z, self._weight = coordinates.to_z(fit.u), fit.weight
        self._likelihood, rng = potential.likelihood, np.random.default_rng(0)
        self._normal = NormalCoordinates(coordinates.base, rng, keeps_edges=False)
        self.free = fit.free
        u = self._normal.from_z(self._z[systematic(self._weight, num_fitted, 0.5)])
        self._fitted = fitted_normals(u, 4, rng)

    def _drawn(self, num: int, rng: np.random.Generator) -> Array:
        # Resampled: a further likelihood would cost a simulation a trial.
        return self._z[rng.choice(len(self._z), size=num, p=self._weight)]

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        u = self._normal.from_z(z)
        log_volume = self._normal.log_slope(u) - self._coordinates.log_jacobian(z)
        density = np.logaddexp(
            np.log1p(-self._defensive) + self._fitted.log_prob(u) + log_volume,
            np.log(self._defensive) + self._log_prior(z),
        )
        return torch.from_numpy(density)

    def _log_likelihood(self, theta: Tensor, z: Array) -> Array:
        floor = self.log_evidence + np.log(self._defensive) - BEYOND
        return self._likelihood(theta, floor=floor)

    def _sample(self, num_samples: int) -> Tensor:
        theta = super()._sample(num_samples)
        if self.free.any():
            fresh = self.prior.sample(torch.Size([num_samples])).to(theta)
            theta = torch.where(torch.from_numpy(self.free), fresh, theta)
        return theta
