r"""Held-out trials far outside what the model of a verdict predicts.

.. math::
    T = \sum_k e_k^2 / s_k^2

over the numbers of a trial, with errors e of the prediction and deviations s that the
model states of them: of its posterior, the noise, and the residual process where every
model misses. Draws of the same errors say how T is distributed, correlations included;
a scaled chi-square with their mean and variance gives the tail. Where every model
misses, errors differ from trial to trial by more than any process says: there a trial
must be as far from what the left-out ones show, by Student's t of the logarithms of
mean squared errors.

References:
    Satterthwaite, Biometrics Bulletin 2 (1946), for the scaled chi-square.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import MissedTrial
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import NONE, Tracing
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import declared_noise, measurement_sds
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.predictive import Prediction
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.seeding import derive_seed

#: Probability that a right verdict has any of its held-out trials called far outside,
#: as that of the chi-squares that refute. What is in another unit, or of another
#: machine, is so far outside that half or twice the level calls the same trials.
LEVEL = 0.01


def missed_trials(
    rivals: RivalSet,
    tracing: Tracing,
    trials: Trials,
    before: Prediction,
    after: Prediction,
    *,
    level: float = LEVEL,
) -> tuple[MissedTrial, ...]:
    """Return the trials far outside what the model of the verdict predicts.

    Args:
        rivals: The models.
        tracing: Tracing with their verdict.
        trials: Trials that had no part in it.
        before: Prediction of the bare model, for these trials.
        after: Prediction of the model of the verdict.
        level: Probability that a right one has any trial called so; each has its share
            (Bonferroni).

    Returns:
        Farthest first.
    """
    m, x, misfit = after.measurements, after.measurements.x, tracing.misfit
    sensor, tails = _sensor(rivals, misfit, m), []
    for prediction, model in ((before, NONE), (after, tracing.model)):
        errors = prediction.x - prediction.mean
        if misfit is not None:
            seed = derive_seed(rivals.seed, "missed")
            every = TrialSimulator(rivals.simulator.model, trials).measurements
            # The first part of a trial may not be scored.
            errors = _beside_process(misfit, every, len(errors), seed)
            errors = errors[:, np.isin(every.position, m.position)]
        tail = _tails(prediction, errors)
        if misfit is not None and sensor is not None:
            error = (x - prediction.middle) / sensor
            among = error, m.trial, len(trials), misfit.of(model).parts
            tail = np.maximum(tail, _beside_others(*among))
        tails.append(np.where(_is_sure_of_none(prediction), 0.0, tail))
    unit = np.sqrt((after.sd**2).mean(0)) if sensor is None else sensor
    share = level / len(trials)
    found = []
    for t in np.flatnonzero(tails[1] < share).tolist():
        at = m.trial == t
        error = (x - after.middle)[at] / unit[at]
        size = float(np.sqrt(np.mean(error**2)))
        missed = MissedTrial(
            position=t,
            name=trials.names[t],
            size=np.inf if _is_sure_of_none(after)[t] else size,
            p_value=float(tails[1][t]),
            by_both=bool(tails[0][t] < share),
            unit="sensor deviations" if sensor is not None else "of its deviations",
        )
        found.append(missed)
    return (*sorted(found, key=lambda trial: -trial.size),)


def outlying_trials(squares: Sequence[float]) -> list[tuple[int, float]]:
    """Return fitted trials whose error is far beyond what all others show.

    The test is Student's t of the logarithms, each trial against the others, with the
    level's share of each (Bonferroni). Fewer than five do not show how errors differ.
    Logarithms have a deviation of at least a half, so that none of ten trials is called
    outlying that errs by less than three times the others, the smallest gross error;
    half and twice make it two and ten times.

    Args:
        squares: Mean squared error of each trial on the fit to the others, in sensor
            variances, shape (t,). Less than one is no better than one.

    Returns:
        Positions and how many times the median of the others the error is, largest
        first.
    """
    logs, found = np.log(np.maximum(squares, 1.0)), []
    for k in range(len(logs) if len(logs) >= 5 else 0):
        others = np.delete(logs, k)
        n = len(others)
        spread = max(others.std(ddof=1), 0.5) * np.sqrt(1 + 1 / n)
        if student.sf((logs[k] - others.mean()) / spread, n - 1) < LEVEL / len(logs):
            found.append((k, float(np.exp(0.5 * (logs[k] - np.median(others))))))
    return sorted(found, key=lambda each: -each[1])


def _tails(prediction: Prediction, errors: Array) -> Array:
    """Return the tail probability of each trial's T, (t,); 1 where none is scored.

    Args:
        prediction: Prediction of the trials.
        errors: Draws of the errors beside it, shape (n, N).
    """
    m, off = prediction.measurements, prediction.mean - prediction.middle
    sd = np.sqrt((off**2).mean(0) + (errors**2).mean(0))
    sd = np.maximum(sd, np.finfo(float).tiny)
    off, errors, own = off / sd, errors / sd, (m.x - prediction.middle) / sd
    found = np.ones(prediction.valid.shape[1])
    for t in np.unique(m.trial):
        at = m.trial == t
        a, b = off[:, at], errors[:, at]
        # Posterior and errors are independent: each draw of one with each of the other.
        drawn = (a**2).sum(1)[:, None] + (b**2).sum(1) + 2 * a @ b.T
        mean, variance = drawn.mean(), drawn.var()
        scale = variance / (2 * mean)
        found[t] = chi2.sf((own[at] ** 2).sum() / scale, mean / scale)
    return found


def _is_sure_of_none(prediction: Prediction) -> NDArray[np.bool_]:
    """Return the trials to which no draw gives a measurement, (t,)."""
    return prediction.probability_valid.max(0) == 0


def _beside_others(
    error: Array, trial: Array, num: int, others: Sequence[float]
) -> Array:
    """Return the tail of each trial's error among those of left-out ones, (t,).

    Args:
        error: Error of each number, in sensor deviations, shape (N,).
        trial: Trial of each number, shape (N,).
        num: Number of trials.
        others: Mean squared errors of left-out trials.
    """
    total = np.bincount(trial, error**2, num)
    square = total / np.maximum(np.bincount(trial, minlength=num), 1)
    own = np.log(np.maximum(square, 1e-300))
    known, n = np.log(np.maximum(others, 1e-300)), len(others)
    spread = known.std(ddof=1) * np.sqrt(1 + 1 / n)
    return student.sf((own - known.mean()) / spread, n - 1)


def _beside_process(misfit: Misfit, m: Measurements, num: int, seed: int) -> Array:
    """Return draws of the sensor's error and the residual process, shape (n, N)."""
    rng = np.random.default_rng(seed)
    sensor = misfit.sensor[m.channel]
    time = 0.0 if np.isnan(misfit.time_scale) else misfit.time_scale
    cell = NoiseCell.of(m, sd=misfit.size * sensor, correlation_time=time)
    cells = np.zeros(num, dtype=np.intp)
    process, _ = NoiseGrid([cell]).errors(cells, np.ones(num), rng)
    return process + sensor * rng.normal(size=process.shape)


def _sensor(rivals: RivalSet, misfit: Misfit | None, m: Measurements) -> Array | None:
    """Return the sensor's deviation, (N,); None if the simulator is the draw."""
    noise = rivals.model.noise
    if misfit is not None:
        return misfit.sensor[m.channel]
    if noise is None:
        return None
    measured = measurement_sds(noise, m)
    if measured is not None:
        return np.broadcast_to(measured, len(m))
    return declared_noise(noise, m).typical_sd
