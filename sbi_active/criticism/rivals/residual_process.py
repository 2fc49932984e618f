r"""A Gaussian process over action, time and order: what no declared effect explains.

.. math::
    r = a\, b\, g(\xi, t) + \epsilon, \qquad
    g \sim \mathcal{GP}\Bigl(0, \exp\bigl(-\tfrac{|\Delta\xi|^2}{2 \ell^2}
    - \tfrac{\Delta t^2}{2 \ell_t^2}\bigr)\Bigr),

independent in each channel. The unit b is the noise's standard deviation, or it is
proportional to the deviation of the prior predictive: what is missing from a simulator
that multiplies or shifts an input grows with the output. The length :math:`\ell` takes
two values. In a third process the order of the trials takes the place of the action:
what warms or wears has structure, if not one of the action. The amplitude a is
log-uniform from the size of the noise to that of the prior predictive. All are summed
out.

References:
    Kennedy & O'Hagan, Journal of the Royal Statistical Society B 63 (2001).
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.error_models import LOG_2PI, NoiseGrid, drawn
from sbi_active.inference.sampling.mixtures import eigh
from sbi_active.inference.sampling.weights import log_sum_exp

#: Length scales, in ranges of the action space: a local and a global misfit.
LENGTHS = (0.1, 0.3)
#: Length scale along a trajectory, in its span.
TIME_LENGTH = 0.3
#: Directions of less than this share of the variance are left out.
NEGLIGIBLE = 1e-5


@dataclass(frozen=True)
class _Basis:
    """The process in whitened coordinates: cov = I + a^2 Q diag(v) Q^T."""

    cell: int
    kind: int  # of the process: one a length, then that of the order
    is_relative: bool
    log_weight: float
    directions: Array  # Q, (N, m), orthonormal
    variances: Array  # v, (m,)


class ResidualProcess:
    """Noise plus a smooth function of the action and time.

    Args:
        noise: The error without the process.
        measurements: Measurements that the residuals belong to.
        action: Action of each trial, in ranges of the action space, shape (t,
            action_dim).
        order: Order of each trial, in the span of those at hand, shape (t,); None for
            no process over it.
        largest: Upper end of the amplitude, in standard deviations of the noise.
        lengths: Length scales, in ranges of the action space.
        spread: Deviation of the prior predictive, shape (N,); None has the noise as the
            only unit.
    """

    def __init__(
        self,
        noise: NoiseGrid,
        measurements: Measurements,
        *,
        action: Array,
        order: Array | None = None,
        largest: float,
        lengths: tuple[float, ...] = LENGTHS,
        spread: Array | None = None,
    ) -> None:
        self.noise, self.measurements, self.spread = noise, measurements, spread
        self.lengths = lengths
        # With an unknown size of the noise, the amplitude is a multiple of it. They are
        # a factor of two apart where the process may be 500 times the noise.
        self.amplitudes = np.geomspace(1.0, max(largest, 3.0), 10)
        typical = self.typical_sd = noise.typical_sd
        units = {False: typical}
        if spread is not None:
            units[True] = self._relative(spread, typical)
        inputs = self._inputs(action, order)
        self._features = [
            (kind, relative, units[relative][:, None] * _features(*points))
            for kind, own in enumerate(inputs)
            for points in [_coordinates(measurements, own, measurements.span)]
            for relative in units
        ]
        self._bases = self._whitened()

    def _whitened(self) -> list[_Basis]:
        """Return each process beside each cell of the noise."""
        found, noise = [], self.noise
        for kind, relative, features in self._features:
            for k, cell in enumerate(noise.cells):
                whitened = cell.whiten(features.T).T
                values, vectors = eigh(whitened.T @ whitened)
                keep = values > NEGLIGIBLE * max(values.max(), 1e-300)
                found.append(
                    _Basis(
                        k,
                        kind,
                        relative,
                        float(noise.log_prior[k] - np.log(len(self._features))),
                        whitened @ (vectors[:, keep] / np.sqrt(values[keep])),
                        values[keep],
                    )
                )
        return found

    def beside(self, weight: Array) -> ResidualProcess:
        """Return the same process beside a noise of other deviations.

        Args:
            weight: Inverse factors on the deviations, shape (N,).
        """
        new, noise = copy(self), self.noise
        cells = [replace(cell, sd=cell.sd / weight) for cell in noise.cells]
        new.noise = replace(noise, cells=cells)
        new._bases = new._whitened()
        return new

    def log_likelihood(self, residual: Array) -> Array:
        """Return log densities, shape (n,), of residuals, shape (n, N)."""
        return log_sum_exp(self._joint(residual).reshape(len(residual), -1), axis=1)

    def condition(
        self,
        residual: Array,
        new: Measurements,
        action: Array,
        *,
        order: Array | None = None,
        spread: Array | None = None,
    ) -> tuple[Array, Array]:
        r"""Return the process at new actions, given residuals, by its best amplitude.

        .. math::
            E[g_* | r] = K_* (K + R)^{-1} r, \qquad
            V[g_* | r] = K_{**} - K_* (K + R)^{-1} K_*^T

        Args:
            residual: Residuals of the measurements at hand, shape (n, N).
            new: Measurements to predict, M.
            action: Actions of all trials, those at hand first, in ranges of the action
                space.
            order: Order of all trials, likewise, in the span of those at hand; needed
                if there is a process over it.
            spread: Spread of the new measurements, shape (M,), where there is one of
                the old.

        Returns:
            Means, shape (n, M), and standard deviations, shape (M,).
        """
        joint = self._joint(residual.mean(0)[None])[0]
        best, at, size = np.unravel_index(np.argmax(joint), joint.shape)
        basis, a = self._bases[best], self.amplitudes[at]
        cell, scale = self.noise.cells[basis.cell], self.noise.scales[size]
        place_of = self._inputs(action, order)[basis.kind]
        own = _coordinates(self.measurements, place_of, self.measurements.span)
        there = _coordinates(new, place_of[-new.shape[0] :], self.measurements.span)
        sd, new_sd = cell.sd * scale, np.full(len(new), np.median(cell.sd) * scale)
        unit, new_unit = sd, new_sd
        if basis.is_relative and spread is not None and self.spread is not None:
            unit = self._relative(self.spread, sd)
            new_unit = unit[0] / self.spread[0] * spread
        within = a**2 * _kernel(own, own) * np.outer(unit, unit)
        across = a**2 * _kernel(there, own) * np.outer(new_unit, unit)
        whitened = cell.whiten(cell.whiten(within).T) / scale**2
        inverse = np.linalg.inv(whitened + np.eye(len(sd)))
        weight = (cell.whiten(across) / scale) @ inverse
        mean = (cell.whiten(residual) / scale) @ weight.T
        explained = np.einsum("mi,mi->m", weight, cell.whiten(across) / scale)
        return mean, np.sqrt(np.maximum((a * new_unit) ** 2 - explained, 0.0))

    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        """Return a cell and a size of the noise for each residual, at random."""
        basis, _, scale = drawn(self._joint(residual), rng)
        cells = np.array([b.cell for b in self._bases])[basis]
        return cells, self.noise.scales[scale]

    def _relative(self, spread: Array, sd: Array) -> Array:
        """Return the spread, in the median as large as the noise."""
        return spread * np.median(sd / spread)

    def _inputs(self, action: Array, order: Array | None) -> list[Array]:
        """Return the places of trials for each process, in lengths, (t, columns)."""
        inputs = [action / length for length in self.lengths]
        if order is not None:
            inputs.append(order[:, None] / 0.3)  # of their span
        return inputs

    def _joint(self, residual: Array) -> Array:
        """Return log p(residual, basis, amplitude, scale), shape (n, bases, ...)."""
        found = []
        for e, q, total, log_p in self._each(residual):
            rest = np.maximum(np.einsum("ni,ni->n", e, e) - (q**2).sum(1), 0.0)
            square = rest[:, None] + q**2 @ (1 / total).T
            found.append(log_p - 0.5 * square[..., None] / self.noise.scales**2)
        return np.stack(found, 1)

    def grams(self, rows: Array) -> tuple[Array, Array]:
        """Return Gram matrices of rows whitened by each process and amplitude.

        Args:
            rows: Residual and its derivatives, shape (N, k).

        Returns:
            Gram matrices, shape (h, k, k), and the log weights of all h with the
            constants of their densities, shape (h,).
        """
        grams, logs = [], []
        for e, q, total, log_p in self._each(rows.T):
            gram = e @ e.T - np.einsum("am,im,jm->aij", 1 - 1 / total, q, q)
            gram = gram[:, None] / self.noise.scales[:, None, None] ** 2
            grams.append(gram.reshape(-1, *gram.shape[2:]))
            logs.append(log_p.ravel())
        return np.concatenate(grams), np.concatenate(logs)

    def left(self, residual: Array) -> Array:
        """Return what the likeliest process leaves of a residual, shape (N,).

        The noise has no correlation.
        """
        joint = self._joint(residual[None])[0]
        best, size, _ = np.unravel_index(np.argmax(joint), joint.shape)
        basis, variance = self._bases[best], self.amplitudes[size] ** 2
        total = 1 + variance * basis.variances
        cell = self.noise.cells[basis.cell]
        along = (1 - 1 / total) * (cell.whiten(residual) @ basis.directions)
        return residual - cell.sd * (basis.directions @ along)

    def _each(self, rows: Array) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Yield rows (n, N) whitened by the noise, process by process.

        With their parts along its directions, the variance along each of these, shape
        (amplitudes, m), and log weights and volumes, shape (amplitudes, scales).
        """
        scales, num = self.noise.scales, rows.shape[1]
        for basis in self._bases:
            cell = self.noise.cells[basis.cell]
            total = 1 + self.amplitudes[:, None] ** 2 * basis.variances
            log_det = 0.5 * np.log(total).sum(1)[:, None] + cell.log_scale
            log_p = self.noise.log_scale_prior - num * (np.log(scales) + 0.5 * LOG_2PI)
            log_p = log_p - log_det + basis.log_weight - np.log(len(self.amplitudes))
            e = cell.whiten(rows)
            yield e, e @ basis.directions, total, log_p


def _coordinates(m: Measurements, place: Array, span: float) -> tuple[Array, Array]:
    """Return points in length scales, shape (N, columns + 1), and channels."""
    time = (m.time - m.time.min()) / (TIME_LENGTH * span)
    return np.column_stack([place[m.trial], time]), m.channel


def _kernel(rows: tuple[Array, Array], columns: tuple[Array, Array]) -> Array:
    distance = ((rows[0][:, None] - columns[0][None]) ** 2).sum(-1)
    return np.exp(-0.5 * distance) * (rows[1][:, None] == columns[1][None])


def _features(points: Array, channel: Array) -> Array:
    """Return F, shape (N, m), with F F^T the process's covariance at unit amplitude.

    Up to 300 points represent the process.
    """
    some = np.unique(np.linspace(0, len(points) - 1, 300).astype(int))
    few = points[some], channel[some]
    values, vectors = eigh(_kernel(few, few))
    keep = values > NEGLIGIBLE * values.max()
    return _kernel((points, channel), few) @ (vectors[:, keep] / np.sqrt(values[keep]))
