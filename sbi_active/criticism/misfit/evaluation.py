"""The error before and after on each left-out trial, the choice repeated without it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.errors import Posterior
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import UNEXPLAINED, Evaluation, ModelKey
from sbi_active.criticism.rivals.error_models import LOG_2PI
from sbi_active.criticism.steps.equivalence import is_large
from sbi_active.criticism.steps.evaluation import joined, scores, summary
from sbi_active.criticism.steps.predictive import NUM_DRAWS, Prediction
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.seeding import derive_seed

Array = NDArray[Any]


def chooses_again(found: Verdict, key: ModelKey) -> bool:
    """Return whether a choice among linear models stands for one among all models.

    Without a time axis a model may bend, and trials are few enough to fit all again, as
    are trajectories of which only parts are left out.

    Args:
        found: Verdict of linear models.
        key: Key of the model that all trials point to.
    """
    if found.is_missed:
        return True
    search, rivals = found.search, found.rivals
    known, by_trial = search.sensor.is_known, search.errors.is_by_trial
    if not (known and by_trial and rivals.measurements.is_sequence):
        return False
    return key in search.found or is_large(rivals.library)  # which takes long


def evaluate_linear(misfit: Verdict, trials: Trials) -> Evaluation | None:
    """Return the error on each trial of models chosen and fitted without it.

    The linearizations are those of all trials; evidence, left-out errors, the choice
    and the refits are made again without each. None if parts of trials are left out.

    Args:
        misfit: The models.
        trials: Trials that were fitted.
    """
    errors = misfit.search.errors
    if not errors.is_by_trial:
        return None
    before, after, selected = [], [], []
    places = np.unique(misfit.rivals.measurements.trial)
    for fold, place in enumerate(places):
        one = trials.select([int(place)])
        key = misfit.selected_without(fold)
        for kept, model in ((before, ModelKey()), (after, key)):
            kept.append(scores(_prediction(misfit, model, fold, int(place)), one))
        is_missed = misfit.is_missed and not key.effects
        selected.append(UNEXPLAINED if is_missed else str(key))
    names = tuple(trials.names[int(i)] for i in places)
    return summary(
        "leave one out", places, joined(before), joined(after), (*selected,), names
    )


def _prediction(misfit: Verdict, key: ModelKey, fold: int, place: int) -> Prediction:
    """Return the prediction of a trial by a model that was fitted without it."""
    search, m = misfit.search, misfit.rivals.measurements
    candidate, errors = search.found[key], search.errors
    posterior = misfit.posterior(key, np.arange(errors.num_folds) != fold)
    seed = derive_seed(misfit.rivals.seed, "left out", str(key), fold)
    rng = np.random.default_rng(seed)
    whole = np.flatnonzero(errors.fold == fold)
    rest = errors.is_scored[whole]
    model = candidate.model
    rows, mean, cov = model.rows[whole], posterior.mean - model.u, posterior.cov
    noise = _covariance(m.time[whole], m.channel[whole], posterior)
    if not rest.all():  # the first samples tell of the trial's nuisances
        first = rows[~rest]
        gain = cov @ first[:, 1:].T
        inside = first[:, 1:] @ gain + noise[np.ix_(~rest, ~rest)]
        gain = np.linalg.solve(inside, gain.T).T
        mean = mean + gain @ (first[:, 0] - first[:, 1:] @ mean)
        cov = cov - gain @ first[:, 1:] @ cov
    at, rows = whole[rest], rows[rest]
    unit = (search.unit * model.scale)[at]
    values, vectors = eigh(cov)
    root = vectors * np.sqrt(np.clip(values, 0, None))
    u = mean + rng.normal(size=(NUM_DRAWS, len(root))) @ root.T
    u = np.clip(u, model.low - model.u, model.high - model.u)
    residual = rows[:, 0] - u @ rows[:, 1:].T
    factor = np.linalg.cholesky(noise[np.ix_(rest, rest)])
    error = rng.normal(size=residual.shape) @ factor.T
    white = np.linalg.solve(factor, residual.T)
    density = -0.5 * (white**2).sum(0) - np.log(np.diag(factor) * unit).sum()
    predicted = m.x[at] - unit * residual
    size = int(np.prod(m.shape[1:]))
    valid = np.ones((NUM_DRAWS, 1))
    return Prediction(
        predicted,
        np.broadcast_to(unit * np.sqrt((factor**2).sum(1)), predicted.shape),
        predicted + unit * error,
        (density - 0.5 * len(at) * LOG_2PI)[:, None],
        np.zeros(len(at), dtype=np.int64),
        m.position[at] - place * size,
        valid > 0,
        valid,
    )


def _covariance(time: Array, channel: Array, posterior: Posterior) -> Array:
    """Return the sensor's error with the process beside it, in sensor variances."""
    apart = np.abs(time[:, None] - time) / posterior.time_scale
    process = np.exp(-apart) * (channel[:, None] == channel)
    return np.eye(len(time)) + posterior.size**2 * process
