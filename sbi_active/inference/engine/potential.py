r"""The likelihood of trials under declared noise, exact wherever it is simulated.

The log density of parameters given trials, up to a constant.

.. math::
    \log p(u) + \sum_k \log p\bigl(x_k \mid f(\theta(u), \xi_k)\bigr)

in coordinates u in which the prior is nearly standard normal and has no edges.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.rounds.rows import rows_of
from sbi_active.inference.sampling.coordinates import NormalCoordinates
from sbi_active.inference.sampling.least_squares import LeastSquares, Whitener
from sbi_active.inference.sampling.row_cache import RowCache
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.outcomes import Outcome
from sbi_active.simulation.workers.settings import Workers


def declares_noise(
    simulator: Callable[..., Any], theta: Tensor, action: Tensor
) -> TypeGuard[SimulatorModel]:
    """Return whether the simulator is a noise-free function beside positive noise.

    It is tried at a few parameters (n, d) and actions (n, action_dim).
    """
    if not isinstance(simulator, SimulatorModel) or simulator.noise is None:
        return False
    is_noisy = bool((simulator.noise.parameters > 0).all())
    if not simulator.draws_by_noise_alone or not is_noisy:
        return False
    return simulator.is_deterministic(theta, action)


class MeanTable:
    """Noise-free outcomes of a simulator with declared noise, each simulated once.

    Attributes:
        num_simulations: Rows simulated so far.
        num_missing: Number of those simulations that a fault lost.
    """

    def __init__(self, simulator: SimulatorModel, workers: Workers) -> None:
        self.simulator, self.workers = simulator, workers
        self.num_simulations = self.num_missing = 0
        # The same object at each call, so that worker processes are kept.
        self._bare = simulator.without_noise()
        self._known: RowCache[Array | None] = RowCache()

    def mean(self, theta: Tensor, action: Tensor) -> tuple[Array, NDArray[np.bool_]]:
        """Return noise-free outcomes at one action, and which rows are lost to faults.

        Float32 parameters (n, d) and action (action_dim,) give shapes (n, *x_shape),
        NaN where there is no measurement, and (n,).
        """

        def simulated(rows: NDArray[np.int64]) -> list[Array | None]:
            return self._simulate(theta[torch.from_numpy(rows)], action)

        found = self._known.get(action.numpy().tobytes(), theta.numpy(), simulated)
        lost = np.array([x is None for x in found])
        shape = next((x.shape for x in found if x is not None), (1,))
        gap = np.full(shape, np.nan)
        mean = np.stack([gap if x is None else x for x in found])
        return mean.astype(np.float64), lost

    def _simulate(
        self, theta: Tensor, action: Tensor, *, batch_size: int = 64
    ) -> list[Array | None]:
        # The same rows a call whatever the number of workers.
        self.num_simulations += len(theta)
        actions = action.expand(len(theta), -1)
        rows = rows_of(
            *(self._bare, theta, actions, 0, self.workers),
            is_first=False,
            batch_size=batch_size,
        )
        if rows is None:
            self.num_missing += len(theta)
            return [None] * len(theta)
        missing = (rows.status == Outcome.MISSING).tolist()
        self.num_missing += sum(missing)
        x = rows.x.numpy()  # kept as it was simulated, in single precision
        return [None if gone else row for gone, row in zip(missing, x, strict=True)]


class SimulatedLikelihood:
    r"""Likelihood of all trials at simulated parameters.

    .. math::
        \log L(\theta) = \sum_k \log p\big(x_k \mid f(\theta, \xi_k)\big),

    with f the noise-free simulator and p its declared noise. A trial without a
    measurement counts as 1 where f has none either, and as 0 elsewhere.

    Args:
        table: Outcomes of f, shared among likelihoods.
        action: Executed actions, shape (t, action_dim).
        x: Observed outcomes, shape (t, *x_shape); NaN where nothing was measured.
        inflation: Factor of the noise's standard deviation.
        deep: Nats below the peak that count as any more do, where trials are ordered.
        forgetting: Share of the latest call in the mean that orders trials (a choice:
            another changes rows that are given up, and no density).
    """

    def __init__(
        self,
        table: MeanTable,
        action: Tensor,
        x: Tensor,
        *,
        inflation: float = 1.0,
        deep: float = 30.0,
        forgetting: float = 0.3,
    ) -> None:
        noise = table.simulator.noise
        assert noise is not None
        self.table, self.noise, self.inflation = table, noise, inflation
        self.action, self.x = action.float(), x.double()
        filled = self.x.nan_to_num(0.0)
        peak = noise.log_prob(self.x, filled).double()
        without = self.x.flatten(1).isnan().all(1)
        #: Largest value of each trial's term, shape (t,).
        self.peak = torch.where(without, 0.0, peak).numpy()
        self._cost = np.full(len(x), deep)  # nats below the peak, on average
        self._deep, self._forgetting = deep, forgetting

    def __len__(self) -> int:
        return len(self.action)

    def terms(self, theta: Tensor, trial: int, *, most: int = 4_000_000) -> Array:
        """Return the log likelihood of one trial, shape (n,).

        Args:
            theta: Parameters, shape (n, d).
            trial: Place of the trial.
            most: Number of outcomes' numbers in double precision at once, 32 MB.
        """
        blocks = theta.split(max(most // self.x[trial].numel(), 64))
        return np.concatenate([self._terms(block, trial) for block in blocks])

    def _terms(self, theta: Tensor, trial: int) -> Array:
        mean, lost = self.table.mean(theta, self.action[trial])
        x = self.x[trial]
        seen = x.isfinite().numpy()
        if not seen.any():
            agrees = np.isnan(mean).reshape(len(mean), -1).all(1)
            return np.where(agrees & ~lost, 0.0, -np.inf)
        agrees = np.isfinite(mean[:, seen]).all(1) & ~lost
        term = np.full(len(mean), -np.inf)
        rows = np.flatnonzero(agrees)
        if len(rows):
            known = torch.from_numpy(mean[rows])
            outcome = x.expand_as(known)
            if self.inflation != 1:
                outcome = known + (outcome - known) / self.inflation
            log_prob = self.noise.log_prob(outcome, known).double().numpy()
            term[rows] = log_prob - seen.sum() * np.log(self.inflation)
        return term

    def __call__(self, theta: Tensor, *, floor: float | Array = -np.inf) -> Array:
        """Return log likelihoods, shape (n,), of parameters, shape (n, d).

        Args:
            theta: Float32.
            floor: A row is given up, as -inf, and the rest of its trials are not
                simulated, once it can no longer reach this; one number, or one a row.
        """
        total = np.zeros(len(theta))
        # What decides comes first.
        left = sorted(range(len(self)), key=lambda k: -self._cost[k])
        for place, k in enumerate(left):
            reachable = total + self.peak[left[place:]].sum() >= floor
            total[~reachable] = -np.inf
            rows = np.flatnonzero(np.isfinite(total))
            if len(rows) == 0:
                break
            term = self.terms(theta[torch.from_numpy(rows)], k)
            depth = float(np.minimum(self.peak[k] - term, self._deep).mean())
            self._cost[k] += self._forgetting * (depth - self._cost[k])
            total[rows] += term
        total[total < floor] = -np.inf
        return total


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

    def log_likelihood(self, u: Array, *, floor: float | Array = -np.inf) -> Array:
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
        step: Step of finite differences, in deviations of the prior.
        largest: Bound on a whitened residual, which keeps sums of squares finite.

    Attributes:
        dim: Number of parameters.
        searched: Coordinates that a search may move, shape (d,).
        num_trials: Number of trials.
        num_observed: Number of observed numbers of all trials.
    """

    def __init__(
        self,
        likelihood: SimulatedLikelihood,
        coordinates: NormalCoordinates,
        *,
        step: float = 3e-3,
        largest: float = 1e6,
    ) -> None:
        self.likelihood, self.coordinates = likelihood, coordinates
        self.dim = coordinates.dim
        self.searched = np.ones(self.dim, dtype=bool)
        self.step, self._largest = step, largest
        self.num_trials = len(likelihood)
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

    def log_likelihood(self, u: Array, *, floor: float | Array = -np.inf) -> Array:
        """Return log likelihoods, shape (n,), of places (n, d).

        Args:
            u: Places.
            floor: Value below which a place is given up, as -inf, or one a place.
        """
        return self.likelihood(self.coordinates.to_theta(u), floor=floor)

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
            part = own.noise.whiten((x - torch.from_numpy(y)) / own.inflation)
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
        return (np.clip(r, -self._largest, self._largest),)

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
