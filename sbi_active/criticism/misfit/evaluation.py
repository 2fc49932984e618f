"""The error before and after, on trials used neither to fit nor to choose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.misfit.draws import posterior
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Evaluation,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.missed_trials import LEVEL, missed_trials, tails_of
from sbi_active.criticism.steps.predictive import NUM_DRAWS, Prediction, predict
from sbi_active.progress import stage
from sbi_active.simulation import GaussianNoise

#: Metrics whose "ratio" is a difference, after minus before.
DIFFERENCES = ("log predictive density", "coverage")
METRICS = ("rmse", "energy score", *DIFFERENCES)


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
    before = after = predict(rivals, held_out, num_draws=num_draws)
    if tracing.verdict != NONE:
        after = predict(rivals, held_out, key=tracing.key, num_draws=num_draws)
    selected, names = (tracing.verdict,) * len(held_out), held_out.names
    found = summary("held out", scores(before), scores(after), selected, names)
    sensor = None
    if rivals.model.noise is not None:
        square = rivals.measurements.by_channel(rivals.sensor.typical_sd**2)
        sensor = np.sqrt(square)
    own = tracing, held_out, before, after
    missed = missed_trials(*own, sensor=sensor, level=level)
    has_size = len(rivals.noise.scales) == 1
    if has_size and isinstance(rivals.model.noise, GaussianNoise):
        every = np.zeros(len(after.measurements), dtype=np.int64)
        found = replace(found, p_value=float(tails_of(after, every)[0]))
    return replace(found, missed=missed)


def evaluate_left_out(
    found: Verdict,
    models: RivalSet,
    trials: Trials,
    *,
    num_draws: int = NUM_DRAWS,
    show_progress: bool = False,
) -> Evaluation:
    """Return the error on each trial of models chosen and fitted without it.

    The linearizations are those of all trials; evidence, left-out errors, the choice
    and the refits are made again without each, and the simulator predicts it. Where no
    effect is chosen, nothing is added, and the error stays.

    Args:
        found: Verdict by all trials.
        models: Its models, with the posteriors of those that are recorded.
        trials: Trials that were fitted.
        num_draws: Draws from each posterior.
        show_progress: Whether to draw a bar of the trials.
    """
    before, after, selected = [], [], []
    places = np.unique(found.rivals.measurements.trial)
    with stage(
        "error before and after, a verdict without each trial",
        show_progress=show_progress,
        count=lambda: (len(selected), len(places)),
    ):
        for place, own in zip(places, found.search.errors.trials, strict=True):
            one = trials.select([int(place)])
            key = found.chosen_by(~own)
            model = _predicting(found, key)
            scored = {}
            for each in dict.fromkeys((ModelKey(), model)):
                fit = posterior(found, models, each, ~own)
                prediction = predict(models, one, fit=fit, num_draws=num_draws)
                scored[each] = scores(prediction)
            before.append(scored[ModelKey()])
            after.append(scored[model])
            named = key.effects and key.error != UNEXPLAINED
            selected.append(
                str(ModelKey(key.effects) if named else ModelKey(error=key.error))
            )
    first, last = (pd.concat(each, ignore_index=True) for each in (before, after))
    names = tuple(trials.names[int(i)] for i in places)
    return summary("leave one out", first, last, (*selected,), names)


def _predicting(found: Verdict, key: ModelKey) -> ModelKey:
    """Return the model that predicts where a verdict without a trial is some key.

    Where all trials scatter, errors are larger than declared in each fold: without one
    of few trials the others may not show it.
    """
    if key.error == OUTLIER:
        return key
    scatters = SCATTER in (key.error, found.key.error)
    if not scatters or found.is_missed or found.states.louder(key):
        return ModelKey(key.effects)
    return ModelKey(key.effects, SCATTER)


def scores(prediction: Prediction) -> pd.DataFrame:
    """Return a row a trial: the metrics, and square and count for the RMSE of all.

    Coverage is that of the central interval of 90 %.
    """
    m, middle = prediction.measurements, prediction.middle
    low, high = np.quantile(prediction.x, [0.05, 0.95], axis=0)
    rows = []
    for t in range(m.shape[0]):
        at = m.trial == t
        y, own = prediction.x[:, at], m.x[at]
        square = float(((middle[at] - own) ** 2).sum())
        half = len(y) // 2
        distance = np.linalg.norm(y - own, axis=1).mean()
        within = np.linalg.norm(y[:half] - y[half : 2 * half], axis=1).mean()
        inside = ((own >= low[at]) & (own <= high[at])).mean()
        rmse, energy = np.sqrt(square / at.sum()), distance - 0.5 * within
        density = prediction.log_density[t]
        rows.append((rmse, energy, density, inside, square, at.sum()))
    columns = pd.Index([*METRICS, "square", "count"])
    return pd.DataFrame(rows, columns=columns, dtype=float)


def summary(
    scheme: Any,
    before: pd.DataFrame,
    after: pd.DataFrame,
    selected: tuple[str, ...],
    names: tuple[str, ...],
) -> Evaluation:
    """Return scores before and after with their contrast, and its interval.

    A bootstrap of 2,000 draws gives the ends of the interval to some percent, and below
    eight trials none that is what it claims to be.
    """
    num, rows = len(before), []
    resampled = np.random.default_rng(0).integers(num, size=(2_000, num))
    for metric in METRICS:
        first, second = (_total(s, metric, np.arange(num)) for s in (before, after))
        interval = None
        if num >= 8:
            each = (_total(s, metric, resampled) for s in (before, after))
            ends = np.quantile(_contrast(metric, *each), [0.05, 0.95])
            interval = tuple(ends.tolist())
        ratio = float(_contrast(metric, first, second))
        rows.append((metric, float(first), float(second), ratio, interval))
    columns = pd.Index(["metric", "before", "after", "ratio", "interval"])
    return Evaluation(
        scheme=scheme,
        before=before,
        after=after,
        table=pd.DataFrame(rows, columns=columns),
        selected=selected,
        names=names,
    )


def _total(scores: pd.DataFrame, metric: str, which: Array) -> Any:
    own = {name: values.to_numpy()[which] for name, values in scores.items()}
    if metric == "rmse":
        return np.sqrt(own["square"].sum(-1) / own["count"].sum(-1))
    return own[metric].mean(-1)


def _contrast(metric: str, before: Any, after: Any) -> Any:
    if metric in DIFFERENCES:
        return after - before
    return after / np.maximum(before, 1e-300)
