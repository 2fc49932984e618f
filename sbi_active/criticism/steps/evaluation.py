"""The error before and after, on trials used neither to fit nor to choose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import NONE, Evaluation, Tracing
from sbi_active.criticism.steps.missed_trials import LEVEL, missed_trials
from sbi_active.criticism.steps.predictive import NUM_DRAWS, Prediction, predict
from sbi_active.simulation import GaussianNoise

#: Metrics whose "ratio" is a difference, after minus before.
DIFFERENCES = ("log predictive density", "coverage")


def evaluate_held_out(
    rivals: RivalSet,
    tracing: Tracing,
    held_out: Trials,
    *,
    num_draws: int = NUM_DRAWS,
    level: float = LEVEL,
) -> Evaluation:
    """Return the error on held-out trials, and which of them are far outside.

    Args:
        rivals: The models, fitted to other trials.
        tracing: Tracing of the fitted trials.
        held_out: Trials to score.
        num_draws: Draws from each posterior.
        level: Probability that a right verdict has any trial called far outside.
    """
    before, after = _predictions(rivals, tracing, held_out, num_draws)
    num = len(held_out)
    found = summary(
        "held out",
        np.arange(num),
        scores(before, held_out),
        scores(after, held_out),
        (tracing.verdict,) * num,
        held_out.names,
    )
    missed = missed_trials(rivals, tracing, held_out, before, after, level=level)
    found = replace(found, missed=missed)
    return replace(found, p_value=tail(after, held_out)) if _is_known(rivals) else found


def _is_known(rivals: RivalSet) -> bool:
    """Return whether errors are Gaussian of a declared size."""
    return (
        isinstance(rivals.model.noise, GaussianNoise) and len(rivals.noise.scales) < 2
    )


def tail(prediction: Prediction, trials: Trials) -> float:
    r"""Return the tail probability of :math:`e^T (S + R)^{-1} e`.

    S is the covariance of the predictions over the posterior, and R that of the noise,
    whose errors are taken as independent.

    Args:
        prediction: Prediction of some trials.
        trials: Trials with what was measured.
    """
    x = trials.x.double().numpy().reshape(-1)[prediction.position]
    off = prediction.mean - prediction.mean.mean(0)
    cov = off.T @ off / (len(off) - 1) + np.diag((prediction.sd**2).mean(0))
    error = x - prediction.middle
    return float(chi2.sf(error @ np.linalg.solve(cov, error), len(error)))


def _predictions(
    rivals: RivalSet, tracing: Tracing, trials: Trials, num_draws: int = NUM_DRAWS
) -> tuple[Prediction, Prediction]:
    before = predict(rivals, trials, num_draws=num_draws)
    if tracing.verdict == NONE:
        return before, before
    return before, predict(rivals, trials, key=tracing.key, num_draws=num_draws)


def scores(
    prediction: Prediction,
    trials: Trials,
    *,
    # a convention: the central interval that reports state
    coverage: float = 0.9,
) -> dict[str, Array]:
    """Return one value a trial of each metric, and squares and counts for the RMSE."""
    x = trials.x.numpy().reshape(-1)[prediction.position]
    middle = prediction.middle
    tail = 0.5 * (1 - coverage)
    low, high = np.quantile(prediction.x, [tail, 1 - tail], axis=0)
    rows = []
    for t in range(len(trials)):
        at = prediction.trial == t
        y, own = prediction.x[:, at], x[at]
        square = float(((middle[at] - own) ** 2).sum())
        half = len(y) // 2
        distance = np.linalg.norm(y - own, axis=1).mean()
        within = np.linalg.norm(y[:half] - y[half : 2 * half], axis=1).mean()
        inside = ((own >= low[at]) & (own <= high[at])).mean()
        rows.append(
            (
                np.sqrt(square / at.sum()),
                distance - 0.5 * within,
                prediction.log_density[t],
                inside,
                square,
                at.sum(),
            )
        )
    columns = np.array(rows, dtype=float).T
    names = ("rmse", "energy score", *DIFFERENCES, "square", "count")
    return dict(zip(names, columns, strict=True))


def joined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Return the scores of several predictions, one after the other."""
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def summary(
    scheme: Any,
    positions: Array,
    before: dict[str, Array],
    after: dict[str, Array],
    selected: tuple[str, ...],
    names: tuple[str, ...],
    *,
    # Draws of the bootstrap, a choice: an end of an interval is known to some percent.
    num_bootstrap: int = 2_000,
    # Trials below which a bootstrap interval is not what it claims to be.
    enough_trials: int = 8,
) -> Evaluation:
    """Return scores before and after with their contrast, and its interval."""
    rng = np.random.default_rng(0)
    num = len(positions)
    resampled = rng.integers(num, size=(num_bootstrap, num))
    rows = []
    for metric in ("rmse", "energy score", *DIFFERENCES):
        first, second = (_total(s, metric, np.arange(num)) for s in (before, after))
        ratio = _contrast(metric, first, second)
        low = high = np.nan
        if num >= enough_trials:
            many = _contrast(
                metric,
                _total(before, metric, resampled),
                _total(after, metric, resampled),
            )
            low, high = np.quantile(many, [0.05, 0.95])
        rows.append((metric, float(first), float(second), float(ratio), low, high))
    columns = ["metric", "before", "after", "ratio", "low", "high"]
    keep = ("rmse", "energy score", *DIFFERENCES)
    return Evaluation(
        scheme=scheme,
        trials=positions,
        before={name: before[name] for name in keep},
        after={name: after[name] for name in keep},
        table=pd.DataFrame(rows, columns=pd.Index(columns)),
        selected=selected,
        names=names,
    )


def _total(scores: dict[str, Array], metric: str, which: Array) -> Any:
    if metric == "rmse":
        square, count = (scores[name][which].sum(-1) for name in ("square", "count"))
        return np.sqrt(square / count)
    return scores[metric][which].mean(-1)


def _contrast(metric: str, before: Any, after: Any) -> Any:
    if metric in DIFFERENCES:
        return after - before
    return after / np.maximum(before, 1e-300)
