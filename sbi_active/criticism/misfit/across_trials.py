r"""The errors that all models share where x has no time axis, over the trials.

.. math::
    C = \sigma^2 (I + s^2 D K D)

in each number of x, independent of its others. K is smooth in the action, with a length
of a tenth or a third of its range, or in the order of the trials, or it is I: what
differs from trial to trial follows neither. D is I, or the deviation of the prior
predictive with a median of one, since what is missing often grows with the output. The
size s is log-uniform, and all is summed out in *every* model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.misfit.linear import LinearModel
from sbi_active.criticism.misfit.processes import (
    FEWEST,
    Errors,
    Grams,
    Posterior,
    sizes_up_to,
)
from sbi_active.criticism.rivals.error_models import NoiseCell
from sbi_active.criticism.rivals.residual_process import LENGTHS, ORDER_LENGTH

Array = NDArray[Any]

#: Numbers that a left-out part has at least: the logarithm of fewer squared errors says
#: more of their scatter than of the model.
LEAST = 3


@dataclass(frozen=True)
class _Blocks:
    """The numbers of one channel, with the bases of its processes."""

    at: NDArray[np.intp]
    bases: list[tuple[Array, Array]] = field(repr=False)


class AcrossTrials(Errors):
    """The grid of errors over measurements without a time axis.

    Args:
        measurements: Of six trials or more, without a time axis.
        unit: Standard deviation of the sensor, shape (N,).
        cells: The sensor's error.
        largest: Root mean square of the residual of a model that misses, in sensor
            deviations.
        action: Of each trial, in ranges of the action space, shape (t, action_dim).
        order: Of each trial, in their span, shape (t,); None for no process over it.
        spread: Deviation of the prior predictive, shape (N,).
    """

    def __init__(
        self,
        measurements: Measurements,
        unit: Array,
        cells: list[NoiseCell],
        *,
        largest: float,
        action: Array,
        order: Array | None,
        spread: Array,
    ) -> None:
        m = self.measurements = measurements
        self.unit = unit
        trials, fold = np.unique(m.trial, return_inverse=True)
        self.fold, self.num_folds = fold.astype(np.int64), len(trials)
        self.is_by_trial, self.is_scored = True, np.ones(len(m), dtype=bool)
        self.sizes, self.times = sizes_up_to(largest), np.array([np.inf])
        self.patterns = []
        each = -(-LEAST * self.num_folds // len(m))
        #: Trials whose errors are compared together, by turns.
        self.piece = np.arange(self.num_folds) % max(self.num_folds // each, FEWEST)
        self._declare(cells)
        order = None if order is None else order[trials]
        #: What trials have in common by each process, shape (t, t).
        self.kernels = _kernels(action[trials], order)
        relative = spread / unit
        #: D by each process, shape (N,).
        self.spreads = [np.ones(len(m)), relative / np.median(relative)]
        self._blocks_of: dict[bytes, list[_Blocks]] = {}

    @property
    @override
    def num_processes(self) -> int:
        return len(self.spreads) * len(self.kernels) * len(self.sizes)

    @override
    def pieces(self, square: Array) -> Array:
        """Return the mean squared error of each group of trials, (g,)."""
        some, num = np.isfinite(square), int(self.piece.max()) + 1
        count = np.bincount(self.piece[some], minlength=num)
        with np.errstate(invalid="ignore"):
            return np.bincount(self.piece[some], square[some], num) / count

    @override
    def grams(self, rows: Array) -> Grams:
        return self._grams(rows, np.ones(len(rows), dtype=bool))

    @override
    def posterior(
        self,
        model: LinearModel,
        grams: Grams,
        folds: Array | None = None,
        *,
        factor: float = 1.0,
    ) -> Posterior:
        if folds is not None:  # trials are not independent of those that do not count
            grams = self._grams(model.rows, np.asarray(folds)[self.fold])
        return super().posterior(model, grams, factor=factor)

    def _grams(self, rows: Array, keep: NDArray[np.bool_]) -> Grams:
        k, n = rows.shape[1], len(self._cells)
        num = n + self.num_processes
        gram, log_det = np.zeros((num, 1, k, k)), np.zeros((num, 1))
        for i, cell in enumerate(self._cells):
            white = (rows / cell.sd[:, None])[keep]
            gram[i, 0] = white.T @ white
            log_det[i, 0] = 2 * np.log(cell.sd[keep]).sum()
        for block in self._of(keep):
            own, at = rows[block.at], n
            for values, vectors in block.bases:
                y = vectors.T @ own
                product = (y[:, :, None] * y[:, None, :]).reshape(len(y), -1)
                v = 1 + self.sizes[:, None] ** 2 * values
                these = slice(at, at + len(self.sizes))
                gram[these, 0] += ((1 / v) @ product).reshape(-1, k, k)
                log_det[these, 0] += np.log(v).sum(1)
                at += len(self.sizes)
        return Grams(gram, log_det, np.array([int(keep.sum())]))

    def _of(self, keep: NDArray[np.bool_]) -> list[_Blocks]:
        key = keep.tobytes()
        if key not in self._blocks_of:
            channel = self.measurements.channel
            self._blocks_of[key] = [
                self._block(np.flatnonzero(keep & (channel == c)))
                for c in np.unique(channel[keep])
            ]
        return self._blocks_of[key]

    def _block(self, at: NDArray[np.intp]) -> _Blocks:
        bases, trial = [], self.fold[at]
        for spread in self.spreads:
            d = spread[at]
            for kernel in self.kernels:
                own = d[:, None] * kernel[np.ix_(trial, trial)] * d
                values, vectors = np.linalg.eigh(own)
                bases.append((np.clip(values, 0, None), vectors))
        return _Blocks(at, bases)


def _kernels(action: Array, order: Array | None) -> list[Array]:
    places = [action / length for length in LENGTHS]
    if order is not None:
        places.append(order[:, None] / ORDER_LENGTH)
    found = [np.eye(len(action))]
    for place in places:
        square = ((place[:, None] - place) ** 2).sum(-1)
        found.append(np.exp(-0.5 * square))
    return found
