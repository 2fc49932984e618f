r"""Held-out trials far outside what the model of a verdict predicts.

.. math::
    T = \sum_k e_k^2 / s_k^2

over the numbers of a trial, with errors e of the prediction and deviations s that the
model states of them: of its posterior and of the errors beside it. Draws of the same
errors say how T is distributed, correlations included; a scaled chi-square with their
mean and variance gives the tail. Where every model misses, errors differ from trial to
trial by more than any process says: there a trial must be as far from what the left-out
ones show, by Student's t of the logarithms of mean squared errors.

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
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.results import NONE, Tracing
from sbi_active.criticism.steps.predictive import Prediction

#: Probability that a right verdict has any of its held-out trials called far outside,
#: as that of the chi-squares that refute. What is in another unit, or of another
#: machine, is so far outside that half or twice the level calls the same trials.
LEVEL = 0.01


def missed_trials(
    tracing: Tracing,
    trials: Trials,
    before: Prediction,
    after: Prediction,
    *,
    sensor: Array | None,
    level: float = LEVEL,
) -> tuple[MissedTrial, ...]:
    """Return the trials far outside what the model of the verdict predicts.

    Args:
        tracing: Tracing with a verdict.
        trials: Trials that had no part in it.
        before: Prediction of the bare model, for these trials.
        after: Prediction of the model of the verdict.
        sensor: Deviation of the sensor by channel, (c,); None if the simulator is the
            draw.
        level: Probability that a right one has any trial called so; each has its share
            (Bonferroni).

    Returns:
        Farthest first.
    """
    m, misfit, num = after.measurements, tracing.misfit, len(trials)
    own, sizes, tails = np.sqrt((after.sd**2).mean(0)), np.empty(num), []
    unit = own if sensor is None else sensor[m.channel]
    for prediction, model in ((before, NONE), (after, tracing.model)):
        error, tail = (m.x - prediction.middle) / unit, tails_of(prediction, m.trial)
        count = np.maximum(np.bincount(m.trial, minlength=num), 1)
        square = np.bincount(m.trial, error**2, num) / count
        if misfit is not None:
            others = np.array(misfit.of(model).parts)
            logs = (np.log(np.maximum(each, 1e-300)) for each in (square, others))
            tail = np.maximum(tail, _beyond(*logs))
        is_sure_of_none = prediction.probability_valid.max(0) == 0
        tails.append(np.where(is_sure_of_none, 0.0, tail))
        sizes = np.where(is_sure_of_none, np.inf, np.sqrt(square))
    missed = [
        MissedTrial(
            position=t,
            name=trials.names[t],
            size=float(sizes[t]),
            p_value=float(tails[1][t]),
            by_both=bool(tails[0][t] < level / num),
        )
        for t in np.flatnonzero(tails[1] < level / num).tolist()
    ]
    return (*sorted(missed, key=lambda trial: -trial.size),)


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
        if _beyond(logs[k], others, least=0.5) < LEVEL / len(logs):
            found.append((k, float(np.exp(0.5 * (logs[k] - np.median(others))))))
    return sorted(found, key=lambda each: -each[1])


def _beyond(own: Array, others: Array, *, least: float = 0.0) -> Array:
    """Return the tail of each number among others, by Student's t.

    Args:
        own: Numbers.
        others: Others, shape (n,).
        least: Standard deviation of these at least.
    """
    spread = max(others.std(ddof=1), least) * np.sqrt(1 + 1 / len(others))
    return student.sf((own - others.mean()) / spread, len(others) - 1)


def tails_of(prediction: Prediction, part: NDArray[np.int64]) -> Array:
    """Return the tail probability of T in each part; 1 where none is scored.

    Args:
        prediction: Prediction of the trials.
        part: Part of each number, a trial for example, shape (N,).
    """
    m, off = prediction.measurements, prediction.mean - prediction.middle
    errors = prediction.x - prediction.mean
    sd = np.sqrt((off**2).mean(0) + (errors**2).mean(0))
    sd = np.maximum(sd, np.finfo(float).tiny)
    off, errors, own = off / sd, errors / sd, (m.x - prediction.middle) / sd
    found = np.ones(prediction.valid.shape[1])
    for t in np.unique(part):
        at = part == t
        a, b = off[:, at], errors[:, at]
        # Posterior and errors are independent: each draw of one with each of the other.
        drawn = (a**2).sum(1)[:, None] + (b**2).sum(1) + 2 * a @ b.T
        mean, variance = drawn.mean(), drawn.var()
        scale = variance / (2 * mean)
        found[t] = chi2.sf((own[at] ** 2).sum() / scale, mean / scale)
    return found
