r"""The log density of parameters given trials, up to a constant.

.. math::
    \log p(u) + \sum_k \log p\bigl(x_k \mid f(\theta(u), \xi_k)\bigr)

in coordinates u in which the prior is nearly standard normal and has no edges.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.inference.engine.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.sampling.least_squares import LeastSquares, Whitener
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.simulation.noise.whitening import whitened

Array = NDArray[Any]

#: Bound on a whitened residual, which keeps sums of squares finite.
LARGEST = 1e6
STEP = 3e-3  # of differences, in deviations of the prior


class Density(Protocol):
    """A likelihood of trials and a prior, in coordinates without scale.

    Attributes:
        num_trials: Number of trials in the likelihood.
    """

    num_trials: int

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def num_simulations(self) -> int:
        """Rows simulated so far, each at one action."""
        ...

    def sample_prior(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (num, dim)."""
        ...

    def simulated(self, u: Array) -> Array:
        """Return the places within the prior that are simulated for u, (k, dim)."""
        ...

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        ...

    def log_likelihood(self, u: Array, *, floor: float = -np.inf) -> Array:
        """Return log likelihoods, shape (n,); -inf allowed of those below a floor."""
        ...


class Potential(Density, LeastSquares, Protocol):
    """A density with residuals, of an error that may have unknowns: it is searched.

    Attributes:
        step: Step of finite differences, in coordinates.
        num_observed: Number of observed numbers of all trials.
    """

    step: float
    num_observed: int

    def whitener(self, u: Array | None = None) -> Whitener:
        """Return the whitener of residuals by the likeliest error at u, shape (1, dim).

        It is the same object if nothing of the error is unknown; None begins a search.
        """
        ...

    def regimes(self, u: Array) -> list[Whitener]:
        """Return whiteners of residuals where the error leaves other widths."""
        ...

    def splits_off(self, axes: NDArray[np.bool_], rng: np.random.Generator) -> bool:
        """Return whether the prior is a product over some axes and all others."""
        ...


def unchanged(residual: Array) -> Array:
    """Return residuals as they are: they are whitened already."""
    return residual


class SimulatedPotential:
    """The potential of a noise-free simulator beside a declared noise.

    Args:
        likelihood: Likelihood of all trials, whose simulations are kept.
        coordinates: Coordinates of the prior.

    Attributes:
        dim: Number of parameters.
        searched: Coordinates that a search may move, shape (d,).
        step: Step of finite differences.
        num_trials: Number of trials.
        num_observed: Number of observed numbers of all trials.
    """

    def __init__(
        self, likelihood: SimulatedLikelihood, coordinates: NormalCoordinates
    ) -> None:
        self.likelihood, self.coordinates = likelihood, coordinates
        self.dim = coordinates.dim
        self.searched = np.ones(self.dim, dtype=bool)
        self.step, self.num_trials = STEP, len(likelihood)
        self.num_observed = int(likelihood.x.isfinite().sum())
        self._spread: Array | None = None

    @property
    def num_simulations(self) -> int:
        """Rows simulated so far, each at one action."""
        return self.likelihood.table.num_simulations

    def sample_prior(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (n, d)."""
        return self.coordinates.sample(num, rng)

    def whitener(self, u: Array | None = None) -> Whitener:
        """Return the whitener of residuals: nothing of the error is unknown."""
        return unchanged

    def regimes(self, u: Array) -> list[Whitener]:
        """Return nothing: no other error is possible."""
        return []

    def splits_off(self, axes: NDArray[np.bool_], rng: np.random.Generator) -> bool:
        """Return whether the prior is a product over some axes and all others."""
        return self.coordinates.splits_off(axes, rng)

    def simulated(self, u: Array) -> Array:
        """Return the places that are simulated for u, in single precision, (n, d).

        Places outside the prior's support are left out.
        """
        c = self.coordinates
        z = c.to_z(u)
        z = c.base.to_z(c.base.to_theta(z[c.base.inside(z)]))
        return c.from_z(z[c.base.inside(z)])

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        return self.coordinates.log_prior(u)

    def log_likelihood(
        self,
        u: Array,
        *,
        floor: float = -np.inf,
        first: int = 0,
        last: int | None = None,
    ) -> Array:
        """Return log likelihoods, shape (n,), of places (n, d).

        Args:
            u: Places.
            floor: Value below which a place is given up, as -inf.
            first: Number of the first trial that counts.
            last: Number after that of the last; None counts all.
        """
        theta = self.coordinates.to_theta(u)
        return self.likelihood(theta, floor=floor, first=first, last=last)

    def residual(self, u: Array) -> tuple[Array]:
        """Return residuals of all trials in deviations of the noise, shape (n, N).

        Residuals of a simulation without a number are large.
        """
        theta, parts = self.coordinates.to_theta(u), []
        own = self.likelihood
        for action, x in zip(own.action, own.x, strict=True):
            y, _ = own.table.mean(theta, action)
            if y.shape[1:] != x.shape:  # all rows are lost or without a number
                y = np.full((len(u), *x.shape), np.nan)
            part = whitened(own.noise, (x - torch.from_numpy(y)) / own.inflation)
            part = part.flatten(1).numpy()
            seen = x.isfinite().flatten().numpy()
            parts.append(np.where(seen, part, 0.0))
        r = np.concatenate(parts, 1)
        if self._spread is None:
            filled = np.where(np.isfinite(r), r, np.nan)
            with np.errstate(all="ignore"):
                spread = np.sqrt(np.nanmean(filled**2, 0)) if len(r) else np.ones(1)
            self._spread = np.where(np.isfinite(spread), spread, 0.0)
        r = np.where(np.isfinite(r), r, self._spread)
        return (np.clip(r, -LARGEST, LARGEST),)

    def jacobian(
        self, u: Array, whiten: Whitener, step: float | Array
    ) -> tuple[Array, Array]:
        """Return residuals (n, N) and derivatives (n, N, d)."""
        n, d = u.shape
        steps = np.where(u > 0, -1.0, 1.0) * step  # towards the middle of the prior
        moved = u[:, None] + steps[:, :, None] * np.eye(d)
        stack = np.concatenate([u, moved.reshape(n * d, d)])
        r = whiten(self.residual(stack)[0])
        rest = r[n:].reshape(n, d, -1) - r[:n, None]
        return r[:n], np.swapaxes(rest / steps[:, :, None], 1, 2)
