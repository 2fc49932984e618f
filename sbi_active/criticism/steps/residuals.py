"""Residuals of a rival: refitted to all trials, and predicted from those before."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey, Residuals
from sbi_active.criticism.rivals.error_models import NoiseGrid
from sbi_active.criticism.steps.predictive import Prediction, predict
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

#: Draws of the prior, and of the posterior; a simulator that jumps is seldom cheap.
NUM_PRIOR, NUM_ROUGH = 2_000, 500


def find_residuals(
    rivals: RivalSet,
    key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
) -> Residuals:
    """Return the residuals of one rival.

    Args:
        rivals: The models and their trials.
        key: Which of them.
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
        prequential=_filled(_prequential(rivals, key), m.position, x.shape),
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


def _prequential(rivals: RivalSet, key: ModelKey) -> Array:
    r"""Return standardized residuals with each trial predicted from those before.

    Prior draws and draws of the posterior of all trials, together, are weighted to
    every posterior in between: from the mixture
    :math:`m(z) = \frac12 (p(z) + p(z | x_{1:t}))`.
    """
    fit = rivals.fit(key)
    rival, evidence = fit.rival, fit.evidence
    rng = np.random.default_rng(rivals.seed)
    num = NUM_PRIOR if rivals.is_smooth else NUM_ROUGH
    prior = rival.coordinates.sample(num, seed=rivals.seed)
    u = np.concatenate([prior, fit.sample.draws(num, rng)])
    residual, log_scale, _ = rival.residual(u, penalized=False)
    # The process is left out: what is asked is how the simulator predicts.
    noise = rivals.noise
    log_l = noise.log_likelihood(residual) - log_scale
    ratio = np.exp(np.clip(log_l - evidence.log_evidence, -700, 700))
    log_start = -np.log(0.5 + 0.5 * ratio)  # log p(z) / m(z)
    m = rivals.measurements
    sd = noise.typical_sd
    found = np.full(len(m), np.nan)
    order = np.argsort(rivals.trials.index.numpy(), kind="stable")
    seen = np.zeros(len(m), dtype=bool)
    for t in order:
        log_w = log_start.copy()
        if seen.any():
            cells = [
                type(c)(c.log_weight, c.sd[seen], c.rho[seen], c.df)
                for c in noise.cells
            ]
            part = NoiseGrid(cells, scales=noise.scales)
            log_w = log_w + part.log_likelihood(residual[:, seen])
        w = np.exp(log_w - log_sum_exp(log_w))
        at = m.trial == t
        middle = w @ residual[:, at]
        spread = w @ (residual[:, at] - middle) ** 2
        found[at] = middle / np.sqrt(spread + sd[at] ** 2)
        seen |= at
    return found


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
