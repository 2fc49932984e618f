"""The best fit of a simulator to trajectories, and draws of its linear model there."""

from __future__ import annotations

from collections.abc import Sequence
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
from sbi_active.criticism.linear.fits import best_fit, polished
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
from sbi_active.inference.sampling.least_squares import basis_of
from sbi_active.simulation import SimulatorModel


@dataclass(frozen=True)
class Linear:
    """A simulator with effects that may be there, linear near its best fit.

    Attributes:
        rival: Rival of theta and the effects beside it.
        effect: Number of the effect that a coordinate belongs to, -1 for none, (d,).
        null: Values at which effects vanish, shape (d,); NaN for other coordinates.
        unit: Root mean square residual of each number's channel, shape (N,).
        fit: Linear model, in units, where it was fitted.
    """

    rival: Rival
    effect: NDArray[np.int64]
    null: Array
    unit: Array
    fit: LinearModel

    def around(
        self,
        fit: LinearModel,
        free: NDArray[np.bool_],
        unit: Array,
        tried: float | None = None,
    ) -> Linear:
        """Return the linear model around a fit of some of the effects.

        Args:
            fit: Linear model in units, without the others.
            free: Coordinates of that model, shape (d,).
            unit: Units of the residuals, shape (N,).
            tried: Deviations of the prior by which the others are tried anew: by a
                chord, since many are flat at their null.
        """
        at = np.array(self.null)
        at[free] = fit.u
        if tried is None:
            columns = self.fit.jacobian[:, ~free]
        else:
            columns = chords(self.rival, at, ~free, tried, fit, unit)
        full = enlarged(fit, self.rival, ~free, at[~free], columns)
        return replace(self, unit=unit, fit=full)

    def without(self, kept: NDArray[np.bool_]) -> Linear:
        """Return the linear model without some of its effects.

        Args:
            kept: Mask of those that it keeps, shape (e,).
        """
        at = np.append(kept, True)[self.effect]
        number = np.append(np.cumsum(kept) - 1, -1)
        return replace(
            self,
            rival=with_effects(self.rival, [*compress(self.rival.effects, kept)]),
            effect=number[self.effect[at]],
            null=self.null[at],
            fit=self.fit.part(at),
        )

    @property
    def origin(self) -> Array:
        """Point of linearization, with effects at their null, shape (d,)."""
        return np.where(self.effect < 0, self.fit.u, self.null)

    def model(self, *, flat: float = 100.0) -> LinearModel:
        """Return the linear model at the origin, from which coordinates count.

        Args:
            flat: Deviation of the Gaussian that stands for a flat prior, in units of
                its range: it leaves the prior as it is, and directions that nothing
                tells solvable.
        """
        fit, origin = self.fit, self.origin
        model = replace(fit, u=origin, residual=fit.at(origin[None])[0]).from_here()
        is_flat = (self.effect < 0) & (self.rival.coordinates.precision == 0)
        return replace(model, sd=np.where(is_flat, flat * (fit.high - fit.low), fit.sd))

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
        aliases: Effects that are left out since parameters do the same.
    """

    errors: ChannelErrors
    draws: Draws
    aliases: tuple[str, ...]

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
        c, fit = self.rival.coordinates, self.fit
        bent = self.rival.residual(u[None])[0][0] / self.unit - fit.at(u[None])[0]
        rows = np.concatenate([bent[:, None], fit.rows[:, 1:][:, free]], 1)
        white = self.whitened(rows, 0 * self.measurements.trial)
        slope, precision = white[:, 1:], np.diag(self.model().sd[free] ** -2)
        step = np.linalg.solve(slope.T @ slope + precision, slope.T @ white[:, 0])
        move = np.clip(u[free] + step, c.low[free], c.high[free]) - u[free]
        return np.abs(move) / (self.draws.u.std(0)[free] + self.rival.step)


def fitted(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    beside: Sequence[Effect],
    *,
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
    fit, unit = _searched(bare, own, seed)
    doubtful = [e for e in beside if e.scope == "campaign"]
    linear, aliases = _beside(with_effects(bare, doubtful), fit, unit, own)
    m, c = linear.measurements, linear.rival.coordinates
    share = 1.0 if known_sd is None else ((known_sd[m.channel] / unit) ** 2).min()
    filters = Filters(own.errors(m, float(share)), m, 0 * m.trial, m.channel)
    there, again = np.zeros(len(linear.rival.effects), dtype=bool), own.linearized
    while True:
        errors = ChannelErrors(
            processes=filters.processes,
            grams=filters.grams(linear.model().rows),
            known=None if known_sd is None else known_sd / linear.sizes,
        )
        draws = _posterior(linear, errors, own, rng).draws(own.num_draws, rng)
        found = Fitted(**vars(linear), errors=errors, draws=draws, aliases=aliases)
        before, there = there, draws.present.mean(0) > own.likely
        free, is_new = np.append(there, True)[linear.effect], (there != before).any()
        u = linear.origin + np.where(free, draws.u.mean(0), 0.0)
        u, again = np.clip(u, c.low, c.high), again - 1
        if not again or not (is_new or found.off(u, free).max() > own.moved):
            return found
        some = with_effects(bare, [*compress(linear.rival.effects, there)])
        if is_new:
            fit, unit = _settled(some, u[free], own)
        else:
            fit = centered(some, linearize(some, u[free], unit), unit)
        linear = linear.around(fit, free, unit, own.tried if is_new else None)


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
    own, model, effects = settings, linear.model(), linear.rival.effects
    every = linear.effect < 0, np.ones(len(linear.effect), dtype=bool)
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
    if not m.has_time or not len(m):
        raise ValueError(
            "expected trajectories with sample times; got outcomes without a time "
            "axis, or none; give sample_times to the simulator or the trials, or use "
            "Campaign"
        )
    num = int(np.prod(trials.x.shape[2:]))
    if lost := [c for c in range(num) if not (m.channel == c).any()]:
        raise ValueError(
            f"expected some measured numbers in every channel; got none in channel "
            f"{lost[0]}; leave it out of x"
        )
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
) -> tuple[LinearModel, Array]:
    """Return the best fit without effects, and the size of each number's residual."""
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
    return _settled(bare, best_fit(bare, u, unit, fit).u, own)


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
    whole: Rival, bare: LinearModel, unit: Array, settings: IdentifySettings
) -> tuple[Linear, tuple[str, ...]]:
    """Return a model with effects that are absent so far, and what parameters imitate.

    Those and what changes nothing are left out.

    Args:
        whole: Rival with all effects.
        bare: Fit without any.
        unit: Units of the residuals, shape (N,).
        settings: Settings of what is told apart.
    """
    own, effect, null = settings, np.full(whole.dim, -1), np.full(whole.dim, np.nan)
    for k, e in enumerate(whole.effects):
        effect[whole.coordinates.places[e.name]] = k
        null[effect == k] = at_null(whole, e, own.tried)[0]
    found = Linear(whole, effect, null, unit, bare)
    found = found.around(bare, effect < 0, unit, own.tried)
    jacobian, basis = found.fit.jacobian, basis_of(bare.jacobian)
    left = jacobian - basis @ (basis.T @ jacobian)
    apart, size = (
        np.sqrt(np.bincount(effect + 1, (part**2).sum(0), len(whole.effects) + 1))[1:]
        for part in (left, jacobian)
    )
    told = apart > own.alias * size
    aliases = compress(whole.effects, ~told & (size > 0))
    return found.without(told), tuple(e.name for e in aliases)
