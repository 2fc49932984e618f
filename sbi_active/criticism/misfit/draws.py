"""Posterior draws of linear models, as those of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.rival_set import NUM_DRAWS, RivalSet
from sbi_active.criticism.linear.errors import Posterior
from sbi_active.criticism.linear.model import LinearModel, reweighted_at
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import Evidence, ModelKey
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.engine import WeightedDraws
from sbi_active.inference.sampling.weights import effective_sample_size, normalized
from sbi_active.seeding import derive_seed


def bends(search: Search, key: ModelKey, *, num: int = 16, most: float = 0.5) -> bool:
    """Return whether the simulator leaves a linear model where its posterior lies.

    A normal posterior is then another one than the simulator's.

    Args:
        search: Search that has fitted the model.
        key: Key of the model.
        num: Number of posterior draws that are simulated.
        most: Standard deviation over the draws of the log density ratio of simulator
            and linear model up to which a model counts as linear, nats. With half, more
            models are sampled.
    """
    rivals, sensor = search.rivals, search.sensor
    if not rivals.is_smooth:
        return False  # its jumps leave any model, and count as noise
    c = search.found[key]
    m, rng = c.model, np.random.default_rng(derive_seed(rivals.seed, "bends"))
    use = np.ones(search.errors.num_folds, bool)
    own = search.errors.posterior(m, c.grams, use, process=False)
    u = m.draws(own.mean, own.cov, num, rng)
    rival, linear = rivals.rival(key), m.residual + (u - m.u) @ m.jacobian.T
    fails = rivals.can_fail and not rivals.measurements.is_sequence
    if fails or rivals.simulator.is_stochastic:
        ratio = rival.log_likelihood(u) + 0.5 * (linear**2).sum(1)
    else:
        noise = rivals.noise if np.isfinite(sensor.df) else sensor.noise
        log_p, unit = noise.log_likelihood, search.unit * m.scale
        ratio = log_p(rival.residual(u)[0]) - log_p(unit * linear)
    return not ratio.std() < most  # NaN: not simulated


def linear_fit(
    rivals: RivalSet,
    key: ModelKey,
    model: LinearModel,
    center: Array,
    cov: Array,
    log_z: float,
    *,
    best: Array | None = None,
    shown: Array | None = None,
    louder: Array | None = None,
    chi_square: float | None = None,
    unit: Array | None = None,
    known: NDArray[np.bool_] | None = None,
    suspect: int | None = None,
) -> Fit:
    """Return a linear model with its draws as its posterior sample.

    Args:
        rivals: Rivals that the model is one of.
        key: Key of the model, with an error or with effects on the noise.
        model: Fitted model of its effects on the prediction.
        center: Center of its posterior, shape (d,).
        cov: Covariance of its posterior, shape (d, d).
        log_z: Log evidence of the model, nats.
        best: Point from which other trials are predicted, shape (d,); None takes the
            draws.
        shown: Covariance of the draws that intervals are of, shape (d, d); None takes
            that of those which predict.
        louder: Draws of effects on the noise, natural values, shape (n, k).
        chi_square: Chi-square with these effects; None takes the fitted model's.
        unit: Unit of the model's residuals, shape (N,), where draws are to be weighed
            by the simulator; None leaves them.
        known: Mask of the numbers that the posterior knows, shape (N,); None for all.
        suspect: Place of the trial that a gross error is in; None without one.
    """

    def linear(u: Array) -> Array:
        residual = model.residual + (u - model.u) @ model.jacobian.T
        return unit * model.scale * residual[:, : model.num]

    rival = rivals.rival(key, suspect=suspect)
    u, at, mode = drawn(rivals, model, center, cov), best, model.u
    if louder is not None:
        u, mode = _with_louder(rival, model, u, louder), None
    equal = np.full(NUM_DRAWS, 1 / NUM_DRAWS)
    sample = WeightedDraws(
        u=u,
        weight=equal,
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        method="linear",
    )
    own = sum(rival.coordinates.joint.sizes)
    if shown is not None:
        u = drawn(rivals, model, center, shown)
    evidence = Evidence(
        key=key,
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(NUM_DRAWS),
        engine="linear",
        names=rivals.names_of(rival),
        draws=rival.coordinates.to_z(u)[:, :own],
        best_chi_square=model.chi_square[0] if chi_square is None else chi_square,
        best=None if at is None else rival.coordinates.to_z(at[None])[0, :own],
    )
    weighs = None if unit is None else linear
    return Fit(rival, sample, evidence, at, mode, weighs, known)


def _with_louder(rival: Rival, model: LinearModel, u: Array, phi: Array) -> Array:
    """Return draws of a model with draws of effects on the noise, shape (n, d).

    Args:
        rival: Rival with these effects.
        model: Model without them.
        u: Draws of its coordinates, shape (n, d').
        phi: Draws of theirs, natural values, shape (m, k), repeated as needed.
    """
    c, noisy = rival.coordinates, np.zeros(rival.dim, dtype=bool)
    for effect in rival.effects:
        noisy[rival.columns()[effect.name]] = effect.hook == "noise"
    drawn = np.empty((len(u), rival.dim))
    drawn[:, ~noisy] = u
    z = c.to_z(np.where(noisy, 0.0, drawn))
    z[:, noisy] = phi[np.arange(len(u)) % len(phi)]
    drawn[:, noisy] = c.from_z(z)[:, noisy]
    return np.clip(drawn, c.low, c.high)


def drawn(rivals: RivalSet, model: LinearModel, center: Array, cov: Array) -> Array:
    """Return draws of a model's coordinates within their bounds, (NUM_DRAWS, d)."""
    rng = np.random.default_rng(derive_seed(rivals.seed, "linear", str(model.key)))
    return model.draws(center, cov, NUM_DRAWS, rng)


def left_out_fit(whole: Fit, known: NDArray[np.bool_]) -> Fit:
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
    sample = WeightedDraws(
        u=own.u,
        weight=normalized(log_w),
        log_evidence=own.log_evidence,
        standard_error=own.standard_error,
        effective_sample_size=effective_sample_size(log_w),
        method=own.method,
    )
    return replace(fit, sample=sample)


def by_weights(
    model: LinearModel, search: Search, use: NDArray[np.bool_], *, rounds: int = 5
) -> tuple[LinearModel, Posterior]:
    """Return a model of t errors with the weights of a fit to some parts, and the fit.

    Args:
        model: Model with the weights of the fit to all.
        search: Search with the errors.
        use: Parts of the trials that count, shape (f,).
        rounds: Times that weights follow from residuals, and the fit from weights;
            two agree to some percent of a deviation.
    """
    errors = search.errors
    for _ in range(rounds):
        grams = errors.grams(model.rows)
        own = errors.posterior(model, grams, use, process=False)
        u = np.clip(own.mean, model.low, model.high)
        model = reweighted_at(model, u, search.sensor.df)
    return model, own
