"""Residuals of a rival that is fitted to all trials."""

from __future__ import annotations

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey, Residuals
from sbi_active.criticism.steps.predictive import Prediction, predict


def find_residuals(
    rivals: RivalSet,
    key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
) -> Residuals:
    """Return the residuals of one rival.

    Args:
        rivals: The models and their trials.
        key: Key of the model.
    """
    trials, m = rivals.trials, rivals.measurements
    prediction = predict(rivals, key=key)
    mean, sd = prediction.moments()
    times = trials.sample_times
    if times is None and rivals.model.sample_times is not None:
        times = rivals.model.sample_times
    x = trials.x.numpy()
    noise = rivals.model.noise
    if noise is None:
        kind = "stochastic"
    else:
        kind = "declared" if noise.posterior is None else "estimated"
    return Residuals(
        action=trials.action.numpy(),
        index=trials.index.numpy(),
        times=None if times is None else times.numpy(),
        x=x,
        mean=_filled(mean, m.position, x.shape),
        sd=_filled(sd, m.position, x.shape),
        refitted=_filled((m.x - mean) / sd, m.position, x.shape),
        correlation=_correlation(rivals, prediction),
        noise=kind,
        probability_valid=prediction.probability_valid.mean(0),
        roughness=(
            _filled(rivals.roughness, m.position, x.shape)
            if rivals.roughness.any()
            else None
        ),
        names=trials.names,
    )


def _filled(values: Array, position: Array, shape: tuple[int, ...]) -> Array:
    x = np.full(int(np.prod(shape)), np.nan)
    x[position] = values
    return x.reshape(shape)


def _correlation(rivals: RivalSet, prediction: Prediction) -> float:
    """Return the posterior mean of the correlation of neighboring errors."""
    m = rivals.measurements
    if not np.isfinite(m.gap).any():
        return 0.0
    residual = m.x - prediction.mean.mean(0)
    weight = rivals.noise.posterior(residual).sum(1)
    follows = np.isfinite(m.gap)
    rho = [float(np.median(c.rho[follows])) for c in rivals.noise.cells]
    return float(weight @ np.array(rho))
