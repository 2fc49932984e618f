"""Residuals of a rival: refitted to all trials, and predicted from those before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey, Residuals
from sbi_active.criticism.steps.predictive import Prediction, predict
from sbi_active.inference.sampling.least_squares import floored
from sbi_active.inference.sampling.student_mixture import (
    StudentMixture,
    lower_factors,
)
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Draws of the prior, more where nothing but these and the posterior's can be had, and
#: of the posterior, which are simulated already.
NUM_PRIOR, NUM_ROUGH, NUM_POSTERIOR = 200, 500, 500
#: Inflation of a covariance, so that a proposal's tails are the heavier.
INFLATION = 1.5
#: Posteriors between the two, and draws of each.
NUM_BETWEEN, NUM_EACH = 4, 50


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

    One set of draws is weighted to every posterior in between:

    .. math::
        w_t(z) = \frac{p(z)\, p(x_{1:t} | z)}{m(z)}, \qquad
        m(z) = \sum_k s_k\, q_k(z)

    with shares s of the draws of the prior, of the posterior of all trials and, where
    derivatives mean anything, of t distributions where the model, linear about its best
    fit, puts the posteriors after some of the trials.

    References:
        Veach and Guibas, SIGGRAPH 1995 (the balance heuristic).
    """
    fit, m, noise = rivals.fit(key), rivals.measurements, rivals.noise
    rival = fit.rival
    rng = np.random.default_rng(rivals.seed)
    order = np.argsort(rivals.trials.index.numpy(), kind="stable")
    seen = [np.isin(m.trial, order[:t]) for t in range(len(order))]
    num = NUM_PRIOR if rivals.is_smooth else NUM_ROUGH
    some = [
        rival.coordinates.sample(num, seed=derive_seed(rivals.seed, "spread")),
        fit.sample.draws(NUM_POSTERIOR, rng),
    ]
    between = None
    if rivals.is_smooth and len(order) > 1:
        after = np.unique(np.geomspace(1, len(order) - 1, NUM_BETWEEN).astype(int))
        between = _between(rivals, fit, [seen[t] for t in after])
        some.append(between.sample(NUM_EACH * len(after), rng))
    u = np.concatenate(some)
    log_p = rival.log_prior(u)
    u, log_p = u[np.isfinite(log_p)], log_p[np.isfinite(log_p)]
    # The process is left out: what is asked is how the simulator predicts.
    residual, log_scale, _ = rival.residual(u, penalized=False)
    log_l = noise.log_likelihood(residual) - log_scale.sum(1)
    parts = [log_p, log_p + np.clip(log_l - fit.evidence.log_evidence, -700, 700)]
    parts += [] if between is None else [between.log_prob(u)]
    log_share = np.log([len(part) / sum(map(len, some)) for part in some])
    log_m = log_sum_exp(np.stack(parts) + log_share[:, None], axis=0)
    sd = noise.typical_sd
    found = np.full(len(m), np.nan)
    for t, before in zip(order, seen, strict=True):
        log_w = log_p - log_m
        if before.any():
            part = noise.part(before)
            log_w = log_w + part.log_likelihood(residual[:, before])
        w = np.exp(log_w - log_sum_exp(log_w))
        at = m.trial == t
        middle = w @ residual[:, at]
        spread = w @ (residual[:, at] - middle) ** 2
        found[at] = middle / np.sqrt(spread + sd[at] ** 2)
    return found


def _between(
    rivals: RivalSet, fit: Fit, seen: Sequence[NDArray[np.bool_]]
) -> StudentMixture:
    """Return t distributions where a linear model puts posteriors of some trials.

    Args:
        rivals: The models.
        fit: Fit of one model.
        seen: Mask of the numbers that each posterior knows, shape (N,) each.
    """
    rival, u = fit.rival, fit.likeliest
    c, free = rival.coordinates, rival.searched
    r = rival.residual(u)[0][0]
    whiten = rivals.noise.whitener(r)
    r, jac = (part[0] for part in rival.jacobian(u, whiten, rivals.step))
    means, covariances = [], []
    for own in seen:
        part = jac[own] * free
        precision = part.T @ part + np.diag(floored(rival))
        pull = part.T @ r[own] + c.precision * (u[0] - c.center)
        means.append(u[0] - np.linalg.solve(precision, pull) * free)
        covariances.append(np.linalg.inv(precision) * INFLATION)
    means = np.clip(np.array(means), c.low, c.high)
    return StudentMixture(means, lower_factors(np.array(covariances)))


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
