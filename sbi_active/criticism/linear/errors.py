r"""The errors that all models share: the sensor's alone, or beside a residual process.

.. math::
    C = \sigma^2 (I + s^2 K_\tau)

in each trial and channel, with :math:`\sigma` of the sensor and the kernels of
:mod:`.processes`. The size s (from .3 up) and the time scale :math:`\tau` (from a
sample to most of a trial) are log-uniform and summed out, in *every* model: what a
simulator gets wrong along a trajectory is no evidence for whichever model is a little
less wrong. Or a parameter differs from trial to trial, with :math:`K = j j^T` in each
trial across its channels and j the derivative of the bare model by it, mean square one:
this and a process are equally likely. Models are linear here (:mod:`.model`), so that
all of it is algebra of Gram matrices.

References:
    Kennedy & O'Hagan, Journal of the Royal Statistical Society B 63 (2001).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.linear.mixture import Mixture, beside_process, summed
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import (
    Filters,
    Grams,
    Processes,
    parts_of,
    time_scales,
    whitened,
)
from sbi_active.criticism.results import OUTLIER, UNEXPLAINED
from sbi_active.criticism.rivals.error_models import LARGEST, LOG_2PI, NoiseGrid, sizes
from sbi_active.criticism.rivals.heavy_tails import tangent
from sbi_active.criticism.steps.predictive import is_first_part
from sbi_active.inference.sampling.weights import log_sum_exp

#: Every so many of the sizes is one of what differs from trial to trial, and every so
#: many of sizes and time scales one of a gross error.
THINNED = 2
#: Trajectories below which parts are left out in their place, and how many parts.
FEWEST, NUM_FOLDS = 6, 8


class Errors:
    """The grid of errors over some measurements.

    Args:
        measurements: Measurements with a time axis.
        unit: Standard deviation of the sensor, shape (N,).
        noise: The sensor's error, with what is unknown of it.
        largest: Root mean square of the residual of a model that misses, in sensor
            deviations: the process may be twice as large.
        warm_up: Time from its first sample in which a left-out trial tells of its
            nuisances, and is not scored.
        varying: Derivatives by what may differ from trial to trial, shape (N, v); it
            counts where parts are trials.

    Attributes:
        fold: Part that each number belongs to, shape (N,): trials, or with fewer than
            six the parts of trials, which are then left out in their place.
        num_folds: Number of folds f.
        is_by_trial: Whether the parts are trials.
        cells: The sensor's error in its units, with what is unknown of its correlation.
        scales: Factors on its size, shape (j,).
        log_sensor: Log prior probability of each of both, cell by cell, shape (c j,).
        is_scored: Numbers that are predicted where their part is left out, bool, (N,).
        varying: Derivatives of mean square one, zero if nothing depends on it.
    """

    def __init__(
        self,
        measurements: Measurements,
        unit: Array,
        noise: NoiseGrid,
        *,
        largest: float,
        warm_up: float = 0.0,
        varying: Array | None = None,
    ) -> None:
        m = self.measurements = measurements
        self.unit = unit
        fewest = FEWEST if m.is_sequence else 1
        self.fold = parts_of(m, fewest, NUM_FOLDS)
        self.is_by_trial = len(np.unique(m.trial)) >= fewest
        self.num_folds = int(self.fold.max()) + 1
        self.is_scored = np.ones(len(m), dtype=bool)
        if self.is_by_trial:
            self.is_scored = ~is_first_part(m, warm_up)
        self.sizes = sizes(max(LARGEST, 2 * largest))
        # Numbers that do not follow each other have errors of their own.
        self.kernels = (False, True) if m.is_sequence else (False,)
        self.times = time_scales(m, self.fold)[: None if m.is_sequence else 1]
        variances = np.stack([np.ones(len(self.sizes)), self.sizes**2], 1)
        self.processes = Processes.grid(variances, self.times, self.kernels)
        self.filters = Filters(self.processes, m, self.fold, self.fold)
        self.cells = [replace(c, sd=c.sd / unit) for c in noise.cells]
        self.scales = noise.scales
        log_p = noise.log_prior[:, None] + noise.log_scale_prior
        self.log_sensor = log_p.ravel()
        if varying is None or not self.is_by_trial:
            varying = np.empty((len(m), 0))
        size = np.sqrt((varying**2).mean(0))
        self.varying = varying / np.where(size > 0, size, 1.0)

    @property
    def is_heavy(self) -> bool:
        """Whether errors of the sensor have the tails of Student's t."""
        return bool(np.isfinite(self.cells[0].df))

    @property
    def num_processes(self) -> int:
        """Errors with a process: kernels, time scales and sizes."""
        return len(self.processes)

    @property
    def spreads(self) -> Array:
        """Sizes of what differs from trial to trial, in sensor deviations."""
        return self.sizes[::THINNED]

    @property
    def log_prior(self) -> Array:
        """Log prior probability of each error beside the sensor's, shape (h - c,)."""
        counts = self.num_processes, self.varying.shape[1] * len(self.spreads)
        each = [np.full(n, -np.log(n)) for n in counts if n]
        return np.concatenate(each) - np.log(len(each))

    def grams(self, model: LinearModel) -> Grams:
        """Return the Gram matrices of a model's rows, the sensor's errors first."""
        every, f, size = model.rows, self.num_folds, len(self.measurements)
        k, rows = every.shape[1], every[:size]
        n, num = len(self.log_sensor), len(self.log_sensor) + len(self.log_prior)
        count = np.bincount(self.fold, minlength=f)
        gram, log_det = np.zeros((num, f, k, k)), np.zeros((num, f))
        for i, cell in enumerate(self.cells):
            white = cell.whiten(rows.T).T
            at = slice(i * len(self.scales), (i + 1) * len(self.scales))
            sizes = 2 * np.log(self.scales)[:, None] * count
            log_det[at] = 2 * np.bincount(self.fold, cell.log_scales, f) + sizes
            for j in range(f):
                own = white[self.fold == j]
                gram[at, j] = own.T @ own / self.scales[:, None, None] ** 2
        at = n + self.num_processes
        process = self._beside(model)
        gram[n:at], log_det[n:at] = process.gram, process.log_det
        for j in range(f) if self.varying.size else ():
            own = rows[self.fold == j]
            plain = own.T @ own
            for v, column in enumerate(self.varying[self.fold == j].T):
                # Sherman and Morrison: of the whole trial one direction counts less.
                pull, square = own.T @ column, column @ column
                growth = self.spreads**2 / (1 + self.spreads**2 * square)
                to = slice(at + v * len(growth), at + (v + 1) * len(growth))
                gram[to, j] = plain - growth[:, None, None] * np.outer(pull, pull)
                log_det[to, j] = np.log1p(self.spreads**2 * square)
        for j in range(f) if len(every) > size else ():
            gram[:, j] += self.unchanged(every, np.arange(f) == j)
        return Grams(gram, log_det, count)

    def unchanged(self, rows: Array, use: NDArray[np.bool_]) -> Array:
        """Return the Gram matrix of the rows that no error changes, shape (k, k).

        Args:
            rows: Rows, shape (N, k) without any or (2 N, k).
            use: Parts of the trials that count, shape (f,).
        """
        extra = rows[len(self.fold) :]
        extra = extra[use[self.fold][: len(extra)]]
        return extra.T @ extra

    def mixture(
        self,
        model: LinearModel,
        grams: Grams,
        use: NDArray[np.bool_] | None = None,
        *,
        beside: bool,
    ) -> Mixture:
        """Return the evidence and the posterior of a model.

        Args:
            model: Linear model with its prior.
            grams: Gram matrices of its rows.
            use: Parts of the trials that count, shape (f,); None takes all.
            beside: Whether there is a residual process beside the sensor's error, or a
                parameter that differs from trial to trial.
        """
        some = np.ones(self.num_folds, bool) if use is None else use
        state = UNEXPLAINED if beside else None
        gram, log_weight = self.hypotheses(model, grams, some, state)
        log_weight = log_weight + model.offset[some[self.fold]].sum()
        return summed(gram, log_weight, model)

    def hypotheses(
        self,
        model: LinearModel,
        grams: Grams,
        use: NDArray[np.bool_],
        state: str | None,
    ) -> tuple[Array, Array]:
        """Return Gram matrices (h, k, k) and log weights (h,) in a state of the error.

        Args:
            model: Linear model.
            grams: Gram matrices of its rows.
            use: Parts of the trials that count, shape (f,).
            state: "unexplained" beside a process or what differs from trial to trial,
                "scatter" where it is larger, "outlier" with a process in one trial;
                None for the sensor's alone.
        """
        n = len(self.log_sensor)
        if state == OUTLIER:
            return self._one_trial(model, grams, use)
        own = slice(n, None) if state == UNEXPLAINED else slice(n)
        gram, constants = grams.gram[own][:, use].sum(1), self.constants(grams, use)
        if state == UNEXPLAINED:
            return gram, self.log_prior + constants[own]
        log_p = self.log_sensor + constants[own]
        if state is None:
            return gram, log_p
        if self.is_heavy:
            size = np.hypot(1, self.sizes)[:, None]
            return self.scaled(model, np.repeat(size, len(self.fold), 1), use)
        size, extra = np.sqrt(1 + self.sizes**2), self.unchanged(model.rows, use)
        log_p = log_p - grams.count[use].sum() * np.log(size)[:, None]
        gram = (gram - extra) / size[:, None, None, None] ** 2 + extra
        return gram.reshape(-1, *gram.shape[2:]), (log_p - np.log(len(size))).ravel()

    def process(self, beside: Mixture) -> tuple[float, float]:
        """Return the mean size and the median time scale of a model's process."""
        shape = len(self.kernels), len(self.times), len(self.sizes)
        log_p = log_sum_exp(beside.log_z[: self.num_processes], axis=1)
        each = np.exp(log_p - log_sum_exp(log_p)).reshape(shape)
        sizes, times = each.sum((0, 1)), each.sum((0, 2))
        middle = min(int(np.searchsorted(np.cumsum(times), 0.5)), len(self.times) - 1)
        return float(sizes @ self.sizes), float(self.times[middle])

    def constants(self, grams: Grams, use: Any = slice(None)) -> Array:
        """Return the log constants of densities of some parts of the trials, (h,)."""
        log_det = grams.log_det[:, use].sum(1)
        return -0.5 * (log_det + grams.count[use].sum() * LOG_2PI)

    def scaled(
        self, model: LinearModel, factors: Array, use: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return Gram matrices of a model under other sizes of the sensor's error.

        Args:
            model: Linear model.
            factors: Factors on the size of each number's error, equally likely, shape
                (s, N).
            use: Parts of the trials that count, shape (f,).

        Returns:
            Gram matrices, shape (c j s, k, k), and log weights, shape (c j s,).
        """
        grams, log_weight, own = [], [], use[self.fold]
        extra, rows = self.unchanged(model.rows, use), model.rows[: len(own)]
        factors, log_size = self._sized(model, factors)
        each = product(self.cells, self.scales)
        for (cell, size), log_p in zip(each, self.log_sensor, strict=True):
            white = cell.whiten(rows.T / (size * factors[:, None]))[..., own]
            grams.append(white @ np.swapaxes(white, 1, 2) + extra)
            log_det = (np.log(size) + log_size + cell.log_scales)[:, own].sum(1)
            log_weight.append(log_p - log_det - 0.5 * own.sum() * LOG_2PI)
        return np.concatenate(grams), np.concatenate(log_weight) - np.log(len(factors))

    def _sized(self, model: LinearModel, factors: Array) -> tuple[Array, Array]:
        """Return factors (s, N) on residuals under errors of other sizes, and logs.

        T errors of another size are touched by another Gaussian: where they are larger,
        no residual is as far out.
        """
        if not self.is_heavy:
            return factors, np.log(factors)
        weight, peak = tangent(model.errors / factors, self.cells[0].df)
        return factors * model.weight / weight, np.log(factors) - peak + model.peak

    def _beside(self, model: LinearModel) -> Grams:
        """Return the Gram matrices of a model's rows beside each process."""
        m, df, count = self.measurements, self.cells[0].df, np.bincount(self.fold)
        if not self.is_heavy:
            return self.filters.grams(model.rows[: len(m)])
        if not m.is_sequence:  # a process is a larger error
            size, cell = np.hypot(1, self.sizes)[:, None], self.cells[0]
            factors, log_size = self._sized(model, np.repeat(size, len(m), 1))
            white = cell.whiten(model.rows.T / factors[:, None])
            parts = [white[..., self.fold == j] for j in range(self.num_folds)]
            gram = np.stack([own @ np.swapaxes(own, 1, 2) for own in parts], 1)
            logs = [np.bincount(self.fold, own + cell.log_scales) for own in log_size]
            return Grams(gram, 2 * np.array(logs), count)

        def grams(own: LinearModel) -> Grams:
            found = self.filters.grams(own.rows)
            gained = np.bincount(self.fold, own.offset - model.offset)
            return replace(found, log_det=found.log_det - 2 * gained)

        def total(own: LinearModel) -> tuple[Array, Array]:
            found = grams(own)
            return found.gram.sum(1), self.constants(found)

        def left(own: LinearModel, found: Mixture) -> Array:
            chosen = np.full(m.channel.max() + 1, np.argmax(found.share))
            rest = own.at(found.mean[None]).T
            return whitened(rest, self.processes, m, chosen, self.fold)[:, 0]

        return grams(beside_process(model, total, left, df))

    def _one_trial(
        self, model: LinearModel, grams: Grams, use: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return Gram matrices with a process in one trial, or what differs in it.

        The sensor's error elsewhere is the most probable one by the other trials. A
        gross error needs no fine grid: of the processes some count.

        Args:
            model: Linear model.
            grams: Gram matrices of its rows.
            use: Parts of the trials that count, shape (f,).

        Returns:
            Gram matrices, shape (t h, k, k), trial by trial, and log weights, (t h,).
        """
        if self.is_heavy:
            return self._one_larger(model, use)
        n, found, weights = len(self.log_sensor), [], []
        shape = len(self.kernels), len(self.times), len(self.sizes)
        places = n + np.arange(len(self.log_prior))
        process, differs = np.split(places, [self.num_processes])
        process = process.reshape(shape)[:, ::THINNED, ::THINNED].ravel()
        parts = [process]
        # Without a time axis a process in a trial is any error of its numbers.
        if self.measurements.is_sequence and len(differs):
            parts.append(differs)
        some = np.concatenate(parts)
        log_prior = [np.full(len(p), -np.log(len(p) * len(parts))) for p in parts]
        for trial in self.trials:
            at, others = trial & use, ~trial & use
            gram = grams.gram[:n, others].sum(1)
            log_p = self.log_sensor + self.constants(grams, others)[:n]
            own = int(np.argmax(summed(gram, log_p, model).share))
            log_det = grams.log_det[own, others].sum()
            log_det = log_det + grams.log_det[some][:, at].sum(1)
            found.append(gram[own] + grams.gram[some][:, at].sum(1))
            weights.append(-0.5 * (log_det + grams.count[use].sum() * LOG_2PI))
        weight = np.array(weights) + np.concatenate(log_prior) - np.log(len(weights))
        return np.concatenate(found), weight.ravel()

    def _one_larger(
        self, model: LinearModel, use: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return what :meth:`_one_trial` returns, with larger errors in the trial."""
        found, weights, size = [], [], np.hypot(1, self.spreads)[:, None]
        for trial in self.trials:
            factors = np.where(trial[self.fold], size, 1.0)
            gram, log_p = self.scaled(model, factors, use)
            found.append(gram)
            weights.append(log_p - np.log(len(self.trials)))
        return np.concatenate(found), np.concatenate(weights)

    @cached_property
    def trials(self) -> list[NDArray[np.bool_]]:
        """Masks of the parts of each trial, shape (f,)."""
        trial = self.measurements.trial
        own = [np.unique(self.fold[trial == t]) for t in np.unique(trial)]
        return [np.isin(np.arange(self.num_folds), parts) for parts in own]

    def weight(self, beside: Mixture) -> Array:
        """Return weights of the squared errors of trials, mean one, shape (N,).

        Weights are the inverse of their mean variance: where a parameter differs from
        trial to trial, a trial that depends on it more tells less of everything else.

        Args:
            beside: Posterior of a model beside a process, or what differs.
        """
        p, end = beside.share, self.num_processes
        process = p[:end].reshape(-1, len(self.sizes)).sum(0) @ self.sizes**2
        differ = p[end:].reshape(-1, len(self.spreads)) @ self.spreads**2
        variance = 1 + process + self.varying**2 @ differ
        count = np.bincount(self.fold, minlength=self.num_folds)
        mean = np.bincount(self.fold, variance, self.num_folds) / count
        weight = 1 / mean[self.fold]
        return weight / weight.mean()
