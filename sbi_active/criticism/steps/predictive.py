"""Posterior predictive of a rival, in trials fitted or not, and residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.results import ModelKey, Residuals
from sbi_active.criticism.rivals.error_models import LOG_2PI
from sbi_active.criticism.rivals.fit import Fit
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import log_outcomes
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import derive_seed, forked_generators


def conditioned(
    rivals: RivalSet,
    fit: Fit,
    u: Array,
    simulator: TrialSimulator,
    rng: np.random.Generator,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return theta and phi with nuisances drawn given the first part of each trial.

    They are solved for within each trial at the mean of the draws, linearized there,
    and drawn for each: their posterior is Gaussian given the draw.

    Args:
        rivals: The models, which say how long the first part is.
        fit: Fit of the model.
        u: Draws of its coordinates, shape (n, dim).
        simulator: Simulator of the trials that were not fitted.
        rng: Source of the draws.
    """
    m = simulator.measurements
    center, spread = rivals.prior_predictive(simulator)
    error = rivals.noise_of(m)
    given = {"error": error, "spread": spread, "center": center}
    rival = replace(fit.rival, simulator=simulator, **given)
    own = fit.rival.residual(u.mean(0, keepdims=True))[0][0]
    size = np.sqrt(np.mean((own / rivals.noise.typical_sd) ** 2))
    unit = error.typical_sd * max(size, 1e-3)
    c, first = rival.coordinates, is_first_part(m, rivals.warm_up)
    own = c.trial_of() >= 0
    z = np.zeros((len(u), c.dim))
    z[:, ~own] = fit.rival.coordinates.to_z(u)[:, : c.num_own]
    draws = c.from_z(z)
    draws[:, own] = c.center[own]

    def whiten(residual: Array) -> Array:
        return np.where(first, residual / unit, 0.0)

    middle = np.clip(draws.mean(0, keepdims=True), c.low, c.high)
    middle, _ = descend(rival, middle, whiten, rivals.step, 10, free=own)
    slope = rival.jacobian(middle, whiten, rivals.step)[1][0][:, own]
    precision = np.maximum(c.precision[own], 1e-6)
    cov = np.linalg.inv(slope.T @ slope + np.diag(precision))
    draws[:, own] = middle[:, own]
    pull = (middle[:, own] - c.center[own]) * c.precision[own]
    draws[:, own] -= (whiten(rival.residual(draws)[0]) @ slope + pull) @ cov
    draws[:, own] += rng.normal(size=(len(u), own.sum())) @ np.linalg.cholesky(cov).T
    return c.split(np.clip(draws, c.low, c.high))


def is_first_part(m: Measurements, warm_up: float) -> NDArray[np.bool_]:
    """Return a mask of numbers within a time of their trial's first, shape (N,)."""
    begin = np.full(m.shape[0], np.inf)
    np.minimum.at(begin, m.trial, m.time)
    return m.time - begin[m.trial] < warm_up


#: A choice: each draw costs a simulation of every trial.
NUM_DRAWS = 200


@dataclass(frozen=True)
class Prediction:
    """Predictions of a rival for measured numbers.

    Attributes:
        mean: Noise-free predictions, one a posterior draw, shape (n, N).
        sd: Standard deviation of the error of each number given a draw, shape (n, N).
        x: Draws with errors, shape (n, N).
        log_likelihood: Log likelihood of the measurements of each trial given the draw,
            noise included, shape (n, t), nats.
        measurements: The measurements that are predicted.
        valid: Whether each trial has an outcome, one draw each, shape (n, t), bool.
        probability_valid: Probability that it has one, given the draw, shape (n, t).
        middle: Prediction that errors refer to, shape (N,): that of the best fit where
            every model misses, else the mean.
    """

    mean: Array
    sd: Array
    x: Array
    log_likelihood: Array
    measurements: Measurements
    valid: Array
    probability_valid: Array
    middle: Array

    @property
    def log_density(self) -> Array:
        """Log density of the measurements of each trial, shape (t,), nats."""
        each = self.log_likelihood
        return log_sum_exp(each, axis=0) - np.log(len(each))

    def moments(self) -> tuple[Array, Array]:
        """Return mean and standard deviation of each number, noise included, (N,)."""
        variance = self.mean.var(0) + (self.sd**2).mean(0)
        return self.mean.mean(0), np.sqrt(variance)


def predict(
    rivals: RivalSet,
    trials: Trials | None = None,
    *,
    key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
    fit: Fit | None = None,
    num_draws: int = NUM_DRAWS,
    seed: int | None = None,
    scored: bool = True,
    near: float = 0.1,
) -> Prediction:
    r"""Return the posterior predictive of a rival.

    If every model misses, its draws are those of a linear model about the best fit
    :math:`\hat u`, and its errors as large as those on left-out trials
    (:class:`.Spread`). Where parameters make up for each other a simulator bends long
    before draws end, so that it is asked near the fit alone:

    .. math::
        f(\hat u) + \frac{f(\hat u + a (u - \hat u)) - f(\hat u)}{a} .

    Args:
        rivals: The models; the rival is fitted to their trials.
        trials: Trials to predict, taken as unseen but for the first part that their
            nuisances are known from, which is left out; None takes those that were
            fitted, with the residual process of "unexplained" conditioned on them.
        key: Key of the model.
        fit: Fit of the model, by some of the trials; None is by all.
        num_draws: Number n of posterior draws.
        seed: Seed of the draws; None is that of the models.
        scored: Whether to compute ``log_likelihood``, which is empty without.
        near: Share a of the distance of draws from a best fit at which the simulator is
            asked: with 1 it bends, below .001 single precision shows.
    """
    fit = rivals.fit(key) if fit is None else fit
    rival, sample, key = fit.rival, fit.sample, fit.rival.key
    seed = rivals.seed if seed is None else seed
    rng = np.random.default_rng(derive_seed(seed, "predictive", str(key)))
    u, own_residual = sample.draws(num_draws, rng), None
    errs = fit.spread
    is_linear = fit.best is not None and (trials is None or not rivals.nuisances)
    if errs is None:
        own_residual = rival.residual(u, penalized=False)[0]
        if fit.known is not None:
            own_residual = own_residual[:, fit.known]
        u, own_residual = fit.weighed(u, own_residual, rng)
    if is_linear:
        jumps = not rivals.is_smooth or rivals.roughness.any()
        near = 1.0 if jumps or rivals.simulator.is_stochastic else near
        assert fit.best is not None
        u = fit.best + near * np.concatenate([np.zeros((1, rival.dim)), u - fit.best])
    target = rivals.trials if trials is None else trials
    simulator = TrialSimulator(
        rivals.simulator.model, target, seed=derive_seed(rivals.seed, "predicted")
    )
    m = simulator.measurements
    theta, phi = rival.coordinates.split(u)
    drops = np.zeros(len(m), dtype=bool)
    if trials is not None and rivals.nuisances and rivals.warm_up > 0:
        theta, phi = conditioned(rivals, fit, u, simulator, rng)
        drops = is_first_part(m, rivals.warm_up) if scored else drops
    elif trials is not None:
        with forked_generators(seed, "fresh nuisances"):
            for effect in rivals.nuisances:  # an unseen trial draws its own
                fresh = effect.sample(num_draws * len(target))
                phi[effect.name] = fresh.reshape(num_draws, len(target), -1)
    if trials is None and not simulator.is_stochastic:  # simulated already
        simulator = rivals.simulator
    mean, unit, probability = simulator.predict(theta, phi)
    noise, at_best = rivals.noise_of(m), None
    if is_linear:
        at_best, mean = mean[0], mean[0] + (mean[1:] - mean[0]) / near
        probability, unit = probability[1:], None if unit is None else unit[1:]
        phi = {name: value[1:] for name, value in phi.items()}
        at_best = np.where(np.isfinite(at_best), at_best, mean.mean(0))
    if errs is not None:  # whose sizes are those of all errors
        middle = mean.mean(0) if at_best is None else at_best
        mean, unit = middle + errs.scale * (mean - middle), None
    factor = simulator.noise_scale(phi, num_draws)
    factor = np.ones_like(mean) if factor is None else factor
    factor = factor if unit is None else factor * unit
    missing, spread = ~np.isfinite(mean), None
    if missing.any() or isinstance(rival.error, ResidualProcess):
        center, spread = rivals.prior_predictive(simulator)
    if missing.any():  # all that is known of such a number is the prior predictive
        wide = spread / noise.typical_sd
        mean, factor = np.where(missing, center, mean), np.where(missing, wide, factor)
    extra = np.zeros(len(m))
    if isinstance(rival.error, ResidualProcess) and own_residual is not None:
        shift, extra = rival.error.condition(
            own_residual,
            m,
            rivals.scaled_actions(target),
            order=rivals.scaled_order(target),
            spread=spread,
        )
        mean = mean + shift
    if errs is not None:
        extra = errs.sizes[m.channel]
        sd = np.zeros(mean.shape) if spread is None else np.where(missing, spread, 0.0)
        errors = errs.errors(m, num_draws, rng) + sd * rng.normal(size=mean.shape)
    else:
        assert own_residual is not None
        cells, sizes = fit.error.noise_posterior(own_residual, rng)
        errors, sd = noise.errors(cells, sizes, rng)
        errors, sd = errors * factor, sd * factor
        errors = errors + extra * rng.normal(size=mean.shape)
    sd = np.sqrt(sd**2 + extra**2)
    each = np.empty((num_draws, len(target) if scored else 0))
    for t in range(each.shape[1]):
        at = (m.trial == t) & ~drops
        residual = (m.x - mean)[:, at]
        # Independent numbers, beside the residual process and where every model misses.
        if errs is not None or extra[at].any():
            e, own = residual / sd[:, at], np.log(sd[:, at])
            each[:, t] = (-0.5 * e**2 - own - 0.5 * LOG_2PI).sum(1)
        else:
            e, log_scale = residual / factor[:, at], np.log(factor[:, at]).sum(1)
            log_p = noise.part(at).log_density(cells, sizes, e)
            each[:, t] = log_p - log_scale
        each[:, t] += log_outcomes(probability[:, [t]], m.valid[[t]])
    kept = ~drops
    return Prediction(
        mean[:, kept],
        sd[:, kept],
        (mean + errors)[:, kept],
        each,
        m.part(kept),
        rng.uniform(size=probability.shape) < probability,
        probability,
        mean[:, kept].mean(0) if at_best is None else at_best[kept],
    )


def find_residuals(
    rivals: RivalSet,
    key: ModelKey = ModelKey(),  # noqa: B008  (frozen)
) -> Residuals:
    """Return the residuals of one rival.

    Args:
        rivals: The models and their trials.
        key: Key of the model.
    """
    trials, m, noise = rivals.trials, rivals.measurements, rivals.model.noise
    prediction = predict(rivals, key=key)
    mean, sd = prediction.middle, prediction.moments()[1]
    times = trials.sample_times
    times = rivals.model.sample_times if times is None else times
    kind = "stochastic"
    if noise is not None:
        kind = "declared" if noise.posterior is None else "estimated"
    x, follows, correlation = trials.x.numpy(), np.isfinite(m.gap), 0.0
    if follows.any():  # the posterior mean of that of neighboring errors
        weight = rivals.noise.posterior(m.x - mean).sum(1)
        rho = [float(np.median(c.rho[follows])) for c in rivals.noise.cells]
        correlation = float(weight @ np.array(rho))

    def filled(values: Array) -> Array:
        every = np.full(x.size, np.nan)
        every[m.position] = values
        return every.reshape(x.shape)

    return Residuals(
        action=trials.action.numpy(),
        index=trials.index.numpy(),
        times=None if times is None else times.numpy(),
        x=x,
        mean=filled(mean),
        sd=filled(sd),
        refitted=filled((m.x - mean) / sd),
        correlation=correlation,
        noise=kind,
        probability_valid=prediction.probability_valid.mean(0),
        roughness=filled(rivals.roughness) if rivals.roughness.any() else None,
        names=trials.names,
    )
