"""Posterior draws of linear models, as those of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.linear.fits import refitted
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import OUTLIER, ModelKey
from sbi_active.criticism.rivals.fit import Fit, Spread
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.rival_set import NUM_DRAWS, RivalSet
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.inference.engine import WeightedDraws
from sbi_active.seeding import derive_seed


def posterior(
    found: Verdict,
    models: RivalSet,
    key: ModelKey,
    use: NDArray[np.bool_] | None = None,
    *,
    fewest: float = 50.0,
) -> Fit:
    """Return a model with draws of its posterior.

    The bare model and those that are likely have samples of the simulator's own
    posterior where they bend and do not miss; of few effective draws a linear model's,
    since a few would claim to know what is open.

    Args:
        found: Verdict with the model.
        models: The verdict's models, with the posteriors by all trials where ``use``
            is given.
        key: Key of the model.
        use: Parts of the trials that count, shape (f,); None takes all.
        fewest: Effective draws that a sample has at least: of 50 a deviation is off by
            a tenth, of half as many by 14 %, of twice as many by 7 %.
    """
    search, whole = found.search, models.fits.get(key)
    if use is not None and whole is not None and whole.evidence.engine != "linear":
        return whole.by(use[search.errors.fold])
    if found.is_missed or not _is_likely(found, key) or not bends(search, key):
        return _linear(found, models, key, use, at_best=found.is_missed)
    if use is None and not found.misses(key):
        fit = models.sampled(key, search.places(key))
        if fit.evidence.effective_sample_size >= fewest:
            log_z = found.states.log_evidence(key)
            return replace(fit, evidence=replace(fit.evidence, log_evidence=log_z))
    return _linear(found, models, key, use, at_best=found.misses(key))


def _is_likely(found: Verdict, key: ModelKey) -> bool:
    """Return whether a model is bare, the verdict's, or one that actions are to tell.

    Simulations along trajectories, and of random simulators, are dear.
    """
    states, rivals = found.states, found.rivals
    if key in (ModelKey(), found.key) or key not in found.search.found:
        return key in found.search.found
    if found.timed or rivals.simulator.is_stochastic or len(key.effects) > 1:
        return False
    every = [*found.search.found, *states.keys(ModelKey())]
    least = max(map(states.log_evidence, every)) - THRESHOLD
    return states.log_evidence(key) >= least


def shown(found: Verdict, fit: Fit) -> Fit:
    """Return a model with the intervals that are shown of it.

    Those of a model that misses know that it does, whichever model explains.
    """
    key, c = fit.rival.key, fit.rival.coordinates
    if not found.misses(key):
        return fit
    model = found.search.model(found.states.predicting(key))
    seed = derive_seed(found.rivals.seed, "linear", str(model.key))
    rng = np.random.default_rng(seed)
    u = model.draws(model.u, found.shown(model.key), NUM_DRAWS, rng)
    best, *draws = c.to_z(np.concatenate([model.u[None], u]))[:, : c.num_own]
    narrow, draws = fit.evidence.draws, np.array(draws)
    own = replace(fit.evidence, draws=draws, best=best, narrow=narrow)
    return replace(fit, evidence=own)


def bends(search: Search, key: ModelKey) -> bool:
    """Return whether the simulator leaves a linear model where its posterior lies.

    A normal posterior is then another one than the simulator's, as it is where another
    fit is as good. It does so from a
    standard deviation of half a nat of the log density ratio of simulator and linear
    model, over 16 draws; with half of it more models are sampled.

    Args:
        search: Search that has fitted the model.
        key: Key of the model.
    """
    rivals = search.rivals
    if not rivals.is_smooth:
        return False  # its jumps leave any model, and count as noise
    if len(search.places(key)) > 1:
        return True
    c = search.found[key]
    m, rng = c.model, np.random.default_rng(derive_seed(rivals.seed, "bends"))
    own = c.sensor
    u = m.draws(own.mean, own.cov, 16, rng)
    rival, linear = rivals.rival(key), m.at(u)
    fails = rivals.can_fail and not rivals.measurements.is_sequence
    if fails or rivals.simulator.is_stochastic:
        ratio = rival.log_likelihood(u) + 0.5 * (linear**2).sum(1)
    else:
        log_p, unit = search.sensor.log_likelihood, search.unit * m.scale
        ratio = log_p(rival.residual(u)[0]) - log_p(unit * linear)
    return not ratio.std() < 0.5  # NaN: not simulated


def _linear(
    found: Verdict,
    models: RivalSet,
    key: ModelKey,
    use: NDArray[np.bool_] | None,
    *,
    at_best: bool,
) -> Fit:
    """Return a linear model with its draws as its posterior sample.

    Wide draws of what misses leave the valleys of what bends: trials are predicted from
    the best fit. A trial with a gross error tells little else.

    Args:
        found: Verdict with the model.
        models: The verdict's models.
        key: Key of the model, with an error or with effects on the noise.
        use: Parts of the trials that count, shape (f,); None takes all.
        at_best: Whether trials are predicted from the best fit.
    """
    states, search = found.states, found.search
    known = None if use is None else use[search.errors.fold]
    rival = models.rival(key, suspect=found.suspect if key.error == OUTLIER else None)
    state = key  # the bare model is what there was before
    if key.effects and found.beside(key).error == OUTLIER:
        state = found.beside(key)
    model = states.candidate(state).model
    seed = derive_seed(models.seed, "linear", str(model.key))
    best, spread = None, None
    linear: Callable[[Array], Array] | None = None

    def drawn(center: Array, cov: Array) -> Array:
        return model.draws(center, cov, NUM_DRAWS, np.random.default_rng(seed))

    if at_best:
        best = model.u
        if known is not None:
            best = refitted(search.rival(key), model, search.units, known)
    if found.is_missed:
        assert best is not None
        log_z = search.found[key].beside.log_evidence
        u, spread = drawn(best, found.covariance(key)), spread_of(found, key, use)
    else:
        at, own = (states.mixture(each, use) for each in (state, key))
        log_z = own.log_evidence
        u = drawn(at.mean if best is None else best, at.cov)
        if best is None:
            linear = partial(_residual, search.unit, model)
        if states.louder(key):
            u = _with_louder(rival, u, states.louder_draws(key, use)[0])
            linear = None
    sample = WeightedDraws(
        u=u,
        weight=np.full(NUM_DRAWS, 1 / NUM_DRAWS),
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        method="linear",
    )
    evidence = models.record(rival, sample, u)
    return Fit(rival, sample, evidence, best, linear, known, spread)


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
    time = errors.process(own.beside)[1] if found.timed else 0.0
    return Spread(np.sqrt(square), total / count, time)


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
