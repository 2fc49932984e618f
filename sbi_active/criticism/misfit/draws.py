"""Posterior draws of linear models, as those of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.fit import Fit, Spread
from sbi_active.criticism.evidence.rival_set import NUM_DRAWS, RivalSet
from sbi_active.criticism.linear.fits import refitted
from sbi_active.criticism.linear.mixture import Mixture
from sbi_active.criticism.linear.model import LinearModel, reweighted_at
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import FEW_DRAWS, OUTLIER, ModelKey
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.inference.engine import WeightedDraws
from sbi_active.inference.sampling.weights import effective_sample_size, normalized
from sbi_active.seeding import derive_seed


def posterior(found: Verdict, models: RivalSet, key: ModelKey) -> Fit:
    """Return a model with draws of its posterior.

    The bare model and those that are likely have samples of the simulator's own
    posterior where they bend and no model misses; of few effective draws
    a linear model's, since a few would claim to know what is open. What is shown of a
    model that misses knows that it does, whichever model explains.

    Args:
        found: Verdict with the model.
        models: The verdict's models, with the bare one's posterior where it is known.
        key: Key of the model.
    """
    fit = _predicting(found, models, key)
    if not found.misses(key):
        return fit
    search, c = found.search, fit.rival.coordinates
    model = search.model(found.states.predicting(key))
    rng = np.random.default_rng(derive_seed(models.seed, "linear", str(model.key)))
    u = model.draws(model.u, found.shown(model.key), NUM_DRAWS, rng)
    u = np.concatenate([model.u[None], u])
    best, *draws = c.to_z(u)[:, : c.num_own]
    narrow, draws = fit.evidence.draws, np.array(draws)
    own = replace(fit.evidence, draws=draws, best=best, narrow=narrow)
    return replace(fit, evidence=own)


def _predicting(found: Verdict, models: RivalSet, key: ModelKey) -> Fit:
    """Return a model with the draws that predict other trials."""
    if not found.is_missed and _is_sampled(found, key):
        near = found.search.model(key).u[None] if key.effects else None
        fit = models.sampled(key, near)
        if fit.evidence.effective_sample_size >= FEW_DRAWS:
            log_z = found.states.log_evidence(key)
            return replace(fit, evidence=replace(fit.evidence, log_evidence=log_z))
    return _linear(found, models, key)


def fitted(
    found: Verdict, models: RivalSet, key: ModelKey, use: NDArray[np.bool_]
) -> Fit:
    """Return a model with its posterior by some parts of the trials.

    Args:
        found: Verdict with the model.
        models: The verdict's models, with their posteriors.
        key: Key of the model.
        use: Parts of the trials that count, shape (f,).
    """
    whole = models.fits.get(key)
    if not (found.is_missed or whole is None or whole.evidence.engine == "linear"):
        return _left_out(whole, use[found.search.errors.fold])
    return _linear(found, models, key, use)


def _is_sampled(found: Verdict, key: ModelKey) -> bool:
    states, search = found.states, found.search
    if key not in search.found:
        return False
    rivals = found.rivals
    is_dear = rivals.measurements.is_sequence or rivals.simulator.is_stochastic
    if is_dear and key not in (ModelKey(), found.key):
        return False
    others = [*search.found, *states.keys(ModelKey())]
    least = max(map(states.log_evidence, others)) - THRESHOLD
    several = len(key.effects) > 1 and key != found.key
    if several or (key.effects and states.log_evidence(key) < least):
        return False
    return bends(search, key)


def bends(search: Search, key: ModelKey) -> bool:
    """Return whether the simulator leaves a linear model where its posterior lies.

    A normal posterior is then another one than the simulator's. It does so from a
    standard deviation of half a nat of the log density ratio of simulator and linear
    model, over 16 draws; with half of it more models are sampled.

    Args:
        search: Search that has fitted the model.
        key: Key of the model.
    """
    rivals, sensor = search.rivals, search.sensor
    if not rivals.is_smooth:
        return False  # its jumps leave any model, and count as noise
    c = search.found[key]
    m, rng = c.model, np.random.default_rng(derive_seed(rivals.seed, "bends"))
    own = c.sensor
    u = m.draws(own.mean, own.cov, 16, rng)
    rival, linear = rivals.rival(key), m.at(u)
    fails = rivals.can_fail and not rivals.measurements.is_sequence
    if fails or rivals.simulator.is_stochastic:
        ratio = rival.log_likelihood(u) + 0.5 * (linear**2).sum(1)
    else:
        noise = rivals.noise if np.isfinite(sensor.df) else sensor.noise
        log_p, unit = noise.log_likelihood, search.unit * m.scale
        ratio = log_p(rival.residual(u)[0]) - log_p(unit * linear)
    return not ratio.std() < 0.5  # NaN: not simulated


def _linear(
    found: Verdict,
    models: RivalSet,
    key: ModelKey,
    use: NDArray[np.bool_] | None = None,
) -> Fit:
    """Return a linear model with its draws as its posterior sample.

    Wide draws of what misses leave the valleys of what bends: trials are predicted from
    the best fit. Beside a gross error, its trial tells little.

    Args:
        found: Verdict with the model.
        models: The verdict's models.
        key: Key of the model, with an error or with effects on the noise.
        use: Parts of the trials that count, shape (f,); None takes all.
    """
    states, search = found.states, found.search
    known = None if use is None else use[search.errors.fold]
    rival = models.rival(key, suspect=found.suspect if key.error == OUTLIER else None)
    model = search.model(states.predicting(key))
    seed = derive_seed(models.seed, "linear", str(model.key))
    best, mode, square, spread = None, model.u, model.chi_square[0], None
    linear: Callable[[Array], Array] | None = None

    def drawn(center: Array, cov: Array) -> Array:
        return model.draws(center, cov, NUM_DRAWS, np.random.default_rng(seed))

    if found.is_missed:
        log_z, best = search.found[key].beside.log_evidence, model.u
        if known is not None:
            best = refitted(search.rival(key), model, search.units, known)
        u, spread = drawn(best, found.covariance(key)), spread_of(found, key, use)
    else:
        at = states.mixture(key, use)
        log_z, beside = at.log_evidence, found.beside(key)
        if beside.error == OUTLIER:
            at = states.mixture(beside, use)
        if use is not None and np.isfinite(search.sensor.df):
            model, at = by_weights(model, search, use)
        u, linear = drawn(at.mean, at.cov), partial(_residual, search.unit, model)
        if states.louder(key):
            phi, square = states.louder_draws(key, use)[0], states.chi_square(key)[0]
            u, mode, linear = _with_louder(rival, u, phi), None, None
    sample = WeightedDraws(
        u=u,
        weight=np.full(NUM_DRAWS, 1 / NUM_DRAWS),
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        method="linear",
    )
    evidence = models.record(rival, sample, u, square)
    return Fit(rival, sample, evidence, best, mode, linear, known, spread)


def spread_of(
    found: Verdict,
    key: ModelKey,
    use: NDArray[np.bool_] | None = None,
    *,
    # Mean squared error, in sensor variances, that counts as none.
    tiny: float = 1e-9,
) -> Spread:
    """Return the errors of a model's predictions by those on left-out parts.

    Args:
        found: The models, where every one misses.
        key: Key of the model that predicts.
        use: Parts of the trials that count, shape (f,); None takes all.
        tiny: Mean squared residual, in sensor variances, that a channel has at least.
    """
    search, errors = found.search, found.search.errors
    own, m, fold = search.found[key], errors.measurements, errors.fold
    rows = own.model.scale[:, None] * own.model.rows[: own.model.num]  # of the sensor
    residual = np.maximum(m.by_channel(rows[:, 0] ** 2), tiny)[m.channel]
    known = ((rows[:, 1:] @ found.covariance(key)) * rows[:, 1:]).sum(1)
    told = np.isfinite(own.left.square) & (True if use is None else use)
    kept = errors.is_scored & told[fold]
    each = own.left.error[kept] ** 2 / (residual + known)[kept]
    total = np.bincount(fold[kept], each, len(told))[told]
    square = m.by_channel((search.unit * rows[:, 0]) ** 2)
    square = np.maximum(square, tiny * m.by_channel(search.unit**2))
    count = np.bincount(fold[kept], minlength=len(told))[told]
    return Spread(np.sqrt(square), total / count)


def _residual(unit: Array, model: LinearModel, u: Array) -> Array:
    """Return residuals of a linear model, (n, N), of coordinates (n, d)."""
    return unit * model.scale * model.at(u)[:, : model.num]


def _with_louder(rival: Rival, u: Array, phi: Array) -> Array:
    """Return draws of a model with draws of effects on the noise, shape (n, d).

    Args:
        rival: Rival with these effects.
        u: Draws of the coordinates without theirs, shape (n, d').
        phi: Draws of theirs, natural values, shape (m, k), repeated as needed.
    """
    c, noisy = rival.coordinates, ~rival.searched
    drawn = np.empty((len(u), rival.dim))
    drawn[:, ~noisy] = u
    z = c.to_z(np.where(noisy, 0.0, drawn))
    z[:, noisy] = phi[np.arange(len(u)) % len(phi)]
    drawn[:, noisy] = c.from_z(z)[:, noisy]
    return np.clip(drawn, c.low, c.high)


def _left_out(whole: Fit, known: NDArray[np.bool_]) -> Fit:
    """Return a sampled model with its posterior by some of the numbers.

    What bends has no linear model that could be fitted again; its draws are weighed by
    the density of the other numbers.

    Args:
        whole: Fit to all numbers, by draws of the simulator's own posterior.
        known: Mask of the numbers that count, shape (N,).
    """
    own, fit = whole.sample, replace(whole, known=known)
    residual, log_scale, _ = whole.rival.residual(own.u, penalized=False)
    lost = np.broadcast_to(log_scale, residual.shape)[:, ~known].sum(1)
    log_w = np.log(np.maximum(own.weight, 1e-300)) + lost
    log_w += fit.error.log_likelihood(residual[:, known])
    log_w -= whole.error.log_likelihood(residual)
    log_w = np.where(np.isfinite(log_w), log_w, -np.inf)
    effective = effective_sample_size(log_w)
    weighed = replace(own, weight=normalized(log_w), effective_sample_size=effective)
    return replace(fit, sample=weighed)


def by_weights(
    model: LinearModel, search: Search, use: NDArray[np.bool_]
) -> tuple[LinearModel, Mixture]:
    """Return a model of t errors with the weights of a fit to some parts, and the fit.

    Args:
        model: Model with the weights of the fit to all.
        search: Search with the errors.
        use: Parts of the trials that count, shape (f,).
    """
    errors = search.errors
    for _ in range(5):  # two agree to some percent of a deviation
        grams = errors.grams(model.rows)
        own = errors.mixture(model, grams, use, beside=False)
        u = np.clip(own.mean, model.low, model.high)
        model = reweighted_at(model, u, search.sensor.df)
    return model, own
