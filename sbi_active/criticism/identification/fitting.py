"""The best fit of a simulator to trajectories, and draws of its linear model there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.identification.posterior import (
    TINY,
    ChannelErrors,
    Draws,
    Posterior,
)
from sbi_active.criticism.identification.settings import IdentifySettings
from sbi_active.criticism.linear.fits import as_good, best_fits, polished
from sbi_active.criticism.linear.model import (
    LinearModel,
    at_null,
    centered,
    chords,
    enlarged,
    linearize,
)
from sbi_active.criticism.linear.processes import Filters, whitened
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.expected import require
from sbi_active.inference.sampling.least_squares import basis_of
from sbi_active.simulation import SimulatorModel


@dataclass(frozen=True)
class Linear:
    """A simulator with effects that may be there, linear near its best fit.

    Attributes:
        rival: Rival of theta and all effects beside it.
        effects: Effects that may be there.
        effect: Number of the effect that a coordinate belongs to, -1 for none, and one
            beyond all for those that are left out, shape (d,).
        origin: Point of linearization, with effects at their null, shape (d,).
        unit: Root mean square residual of each number's channel, shape (N,).
        model: Linear model, in units, whose coordinates count from the origin.
        aliases: Names of effects that are left out since parameters do the same.
        others: Other fits without effects that are as good, shape (k, d').
    """

    rival: Rival
    effects: Sequence[Effect]
    effect: NDArray[np.int64]
    origin: Array
    unit: Array
    model: LinearModel
    aliases: tuple[str, ...]
    others: Array

    def around(
        self,
        fit: LinearModel,
        free: NDArray[np.bool_],
        unit: Array,
        tried: float,
        *,
        flat: float = 100.0,
    ) -> Linear:
        """Return the linear model around a fit of some of the effects.

        Args:
            fit: Linear model in units, without the others.
            free: Coordinates of that model, shape (d,).
            unit: Units of the residuals, shape (N,).
            tried: Deviations of the prior by which the others are tried: by a chord,
                since many are flat at their null.
            flat: Deviation of the Gaussian that stands for a flat prior, in units of
                its range: it leaves the prior as it is, and directions that nothing
                tells solvable.
        """
        c, is_own, at = self.rival.coordinates, self.effect < 0, self.origin.copy()
        at[free] = fit.u
        columns = chords(self.rival, at, ~free, tried, fit, unit)
        full = enlarged(fit, self.rival, ~free, at[~free], columns)
        origin = np.where(is_own, at, self.origin)
        is_flat = is_own & (c.precision == 0)
        sd = np.where(is_flat, flat * (c.high - c.low), full.sd)
        model = replace(full, u=origin, residual=full.at(origin[None])[0], sd=sd)
        return replace(self, origin=origin, unit=unit, model=model.from_here())

    def free(self, present: Iterable[int]) -> NDArray[np.bool_]:
        """Return the coordinates that are not zero, (d,), by the effects present."""
        return np.isin(self.effect, [-1, *present])

    def only(self, present: NDArray[np.bool_]) -> Rival:
        """Return the rival of theta and some of the effects, mask of shape (e,)."""
        return with_effects(self.rival, [*compress(self.effects, present)])

    @property
    def sizes(self) -> Array:
        """The unit of each channel, shape (c,)."""
        return self.unit[np.unique(self.measurements.channel, return_index=True)[1]]

    @property
    def measurements(self) -> Measurements:
        """Measurements that are fitted."""
        return self.rival.simulator.measurements


@dataclass(frozen=True)
class Fitted(Linear):
    """A linear model with posterior draws.

    Attributes:
        errors: Errors of each channel.
        draws: Draws of u - ``origin``.
    """

    errors: ChannelErrors
    draws: Draws

    def whitened(self, rows: Array, fold: NDArray[np.int64]) -> Array:
        """Return rows (N, k) whitened by the likeliest error of each channel.

        Args:
            rows: Rows in units.
            fold: Part of each number, shape (N,), with errors of its own.
        """
        m, own = self.measurements, self.errors
        shape, variance = own.likeliest(self.draws.u.mean(0))
        white = whitened(rows, own.processes, m, shape, fold)
        return white / np.sqrt(variance)[m.channel, None]

    def off(self, u: Array, free: NDArray[np.bool_]) -> Array:
        """Return how far the simulator at a place would move it, in deviations, (k,).

        Args:
            u: Mean of the posterior, shape (d,).
            free: Coordinates that may move, shape (d,).
        """
        model, at = self.model, (u - self.origin)[None]
        bent = self.rival.residual(u[None])[0][0] / self.unit - model.at(at)[0]
        rows = np.concatenate([bent[:, None], model.rows[:, 1:][:, free]], 1)
        white = self.whitened(rows, 0 * self.measurements.trial)
        slope, precision = white[:, 1:], np.diag(model.sd[free] ** -2)
        step = np.linalg.solve(slope.T @ slope + precision, slope.T @ white[:, 0])
        ends = (model.low[free], model.high[free])
        move = np.clip(at[0, free] + step, *ends) - at[0, free]
        return np.abs(move) / (self.draws.u.std(0)[free] + self.rival.step)


def fitted(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    beside: Sequence[Effect],
    known_sd: Array | None,
    seed: int,
    settings: IdentifySettings,
) -> Fitted:
    """Return a simulator near its best fit to trajectories.

    Args:
        model: Simulator with a noise of any kind, of which nothing is used.
        prior: Prior of theta.
        trials: Trials that are fitted.
        beside: Effects that may be there; those of scope "trial" are.
        known_sd: Deviation of each channel's white errors, shape (c,); None estimates.
        seed: Seed of all draws.
        settings: Settings of what is spent.
    """
    own, rng = settings, np.random.default_rng(seed)
    bare = _bare(model, prior, trials, beside, own, seed)
    fit, unit, others = _searched(bare, own, seed)
    doubtful = [e for e in beside if e.scope == "campaign"]
    linear = _beside(with_effects(bare, doubtful), fit, unit, others, own)
    m, c = linear.measurements, linear.rival.coordinates
    share = 1.0 if known_sd is None else ((known_sd[m.channel] / unit) ** 2).min()
    filters = Filters(own.errors(m, float(share)), m, 0 * m.trial, m.channel)
    there, again = np.zeros(len(linear.effects), dtype=bool), own.linearized
    while True:
        errors = ChannelErrors(
            processes=filters.processes,
            grams=filters.grams(linear.model.rows),
            known=None if known_sd is None else known_sd / linear.sizes,
        )
        draws = _posterior(linear, errors, own, rng).draws(own.num_draws, rng)
        found = Fitted(**vars(linear), errors=errors, draws=draws)
        before, there = there, draws.present.mean(0) > own.likely
        free, is_new = linear.free(there.nonzero()[0]), (there != before).any()
        u = linear.origin + np.where(free, draws.u.mean(0), 0.0)
        u, again = np.clip(u, c.low, c.high), again - 1
        if not again or not (is_new or found.off(u, free).max() > own.moved):
            return found
        some = linear.only(there)
        if is_new:
            fit, unit = _settled(some, u[free], own)
        else:
            fit = centered(some, linearize(some, u[free], unit), unit)
        linear = linear.around(fit, free, unit, own.tried)


def _posterior(
    linear: Linear,
    errors: ChannelErrors,
    settings: IdentifySettings,
    rng: np.random.Generator,
) -> Posterior:
    """Return the posterior of a linear model.

    Errors are drawn by what is left with no effect and with all of them, and then by
    what the posterior given these leaves.

    Args:
        linear: The linear model.
        errors: Errors of its rows.
        settings: Settings of what is spent.
        rng: Source of the draws.
    """
    own, model, effects = settings, linear.model, linear.effects
    every = linear.free(()), linear.free(range(len(effects)))
    places = [errors.places(model, free, own.num_places, rng) for free in every]

    def given() -> Posterior:
        drawn = errors.drawn(np.concatenate(places), own.num_errors, rng)
        return Posterior(model, effects, linear.effect, *drawn, own.near)

    places.append(given().draws(own.num_places, rng).u)
    return given()


def _bare(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    beside: Sequence[Effect],
    settings: IdentifySettings,
    seed: int,
) -> Rival:
    """Return the rival without effects, whose simulations all others share."""
    index = int(trials.index.max()) + 1
    augmented = AugmentedSimulator(model, beside, next_index=index)
    simulator = TrialSimulator(augmented, trials, seed=seed)
    m = simulator.measurements
    expected, got = "trajectories with sample times", "outcomes without a time axis"
    advice = "give sample_times to the simulator or the trials, or use Campaign"
    require(m.has_time and len(m) > 0, expected, f"{got}, or none", advice)
    num = int(np.prod(trials.x.shape[2:]))
    lost = [c for c in range(num) if not (m.channel == c).any()]
    expected, got = "measured numbers in every channel", f"none in channels {lost}"
    require(not lost, expected, got, "leave them out of x")
    spread = [max(m.x[m.channel == c].std(), TINY) for c in range(num)]
    scale = np.array(spread)[m.channel]
    return Rival(
        key=ModelKey(),
        simulator=simulator,
        prior=prior,
        effects=(),
        nuisances=[e for e in beside if e.scope == "trial"],
        error=NoiseGrid([NoiseCell.of(m, sd=scale)]),
        spread=scale,
        center=np.zeros(len(scale)),
        step=settings.step,
    )


def with_effects(rival: Rival, effects: Sequence[Effect]) -> Rival:
    """Return a rival with these effects."""
    key = ModelKey(tuple(e.name for e in effects))
    return replace(rival, key=key, effects=effects)


def _searched(
    bare: Rival, settings: IdentifySettings, seed: int
) -> tuple[LinearModel, Array, Array]:
    """Return the best fit without effects, its residuals' sizes, others as good."""
    own, c = settings, bare.coordinates
    num = max(own.num_screened, own.screened_each * bare.theta_dim)
    u = np.concatenate([np.zeros((1, c.dim)), c.sample(num, seed=seed)])
    u = np.clip(u, c.low, c.high)
    r = bare.residual(u)[0]
    best = np.argmin(((r / bare.spread) ** 2).sum(1))
    unit = _sizes(bare, r[best], own)
    fit, dim = own.fit, bare.theta_dim
    fit = replace(
        fit,
        num_starts=max(fit.num_starts, round(own.starts_each * dim)),
        num_kept=max(fit.num_kept, round(own.kept_each * dim)),
    )
    first, *others = best_fits(bare, u, unit, fit)
    best, unit = _settled(bare, first.u, own)
    u = np.array([other.u for other in others]).reshape(-1, bare.dim)
    return best, unit, as_good(bare, best, u, unit, fit)


def _settled(
    rival: Rival, u: Array, settings: IdentifySettings
) -> tuple[LinearModel, Array]:
    """Return a best fit that weighs each channel by its residual at the start."""
    unit = _sizes(rival, rival.residual(u[None])[0][0], settings)
    return polished(rival, u, unit, settings.fit), unit


def _sizes(rival: Rival, residual: Array, settings: IdentifySettings) -> Array:
    """Return the root mean square of each number's channel, shape (N,)."""
    m = rival.simulator.measurements
    rms = np.sqrt(m.by_channel(residual**2))
    return np.maximum(rms[m.channel], settings.smallest * rival.spread)


def _beside(
    whole: Rival,
    bare: LinearModel,
    unit: Array,
    others: Array,
    settings: IdentifySettings,
) -> Linear:
    """Return a model with effects that are absent so far.

    What changes nothing, or what parameters imitate, is left out.

    Args:
        whole: Rival with all effects.
        bare: Fit without any.
        unit: Units of the residuals, shape (N,).
        others: Other fits that are as good, shape (k, d').
        settings: Settings of what is told apart.
    """
    own, effects, u = settings, whole.effects, np.zeros(whole.dim)
    number, places = np.full(whole.dim, -1), whole.coordinates.places
    for k, e in enumerate(effects):
        number[places[e.name]] = k
        u[places[e.name]] = at_null(whole, e, own.tried)[0]
    linear = Linear(whole, effects, number, u, unit, bare, (), others)
    linear = linear.around(bare, number < 0, unit, own.tried)
    jacobian, basis = linear.model.jacobian, basis_of(bare.jacobian)
    left = jacobian - basis @ (basis.T @ jacobian)
    apart, size = (
        np.sqrt(np.bincount(number + 1, (part**2).sum(0), len(effects) + 1))[1:]
        for part in (left, jacobian)
    )
    told = apart > own.alias * size
    renumbered = np.where(told, np.cumsum(told) - 1, told.sum())
    return replace(
        linear,
        effects=[*compress(effects, told)],
        effect=np.append(renumbered, -1)[number],
        aliases=tuple(e.name for e in compress(effects, ~told & (size > 0))),
    )
