"""The best fit of a simulator to trajectories, and draws of its linear model there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.identification.posterior import TINY, Draws, Sampler, Unknowns
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
from sbi_active.criticism.linear.processes import Filters, Processes, parts_of, whitened
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
        model: Linear model, in units.
    """

    rival: Rival
    effect: NDArray[np.int64]
    null: Array
    unit: Array
    model: LinearModel

    def around(
        self,
        model: LinearModel,
        free: NDArray[np.bool_],
        unit: Array,
        tried: float | None = None,
    ) -> Linear:
        """Return the linear model around a fit of some of the effects.

        Args:
            model: Linear model in units, without the others.
            free: Coordinates of that model, shape (d,).
            unit: Units of the residuals, shape (N,).
            tried: Deviations of the prior by which the others are tried anew: by a
                chord, since many are flat at their null.
        """
        at = np.array(self.null)
        at[free] = model.u
        if tried is None:
            columns = self.model.jacobian[:, ~free]
        else:
            columns = chords(self.rival, at, ~free, tried, model, unit)
        full = enlarged(model, self.rival, ~free, at[~free], columns)
        return replace(self, unit=unit, model=full)

    def of(self, rival: Rival, bare: LinearModel) -> Linear:
        """Return the linear model with some of its effects.

        Args:
            rival: Rival with those effects.
            bare: Linear model in units, without any.
        """
        kept = [e in rival.effects for e in self.rival.effects]
        at = np.append(kept, True)[self.effect]
        effect, null = (
            np.append(np.cumsum(kept) - 1, -1)[self.effect[at]],
            self.null[at],
        )
        new = effect >= 0
        columns = self.model.jacobian[:, at][:, new]
        model = enlarged(bare, rival, new, null[new], columns)
        return replace(self, rival=rival, effect=effect, null=null, model=model)

    @property
    def origin(self) -> Array:
        """Point of linearization, with effects at their null, shape (d,)."""
        return np.where(self.effect < 0, self.model.u, self.null)

    @property
    def rows(self) -> Array:
        """Residual at the origin and its derivatives, in units, shape (N, 1 + d)."""
        j = self.model.jacobian
        r = self.model.residual + j @ (self.origin - self.model.u)
        return np.concatenate([r[:, None], j], 1)

    @property
    def unknowns(self) -> Unknowns:
        """Prior knowledge of u - ``origin``."""
        c, at = self.rival.coordinates, self.origin
        is_flat = (self.effect >= 0) & (c.precision == 0)
        precision = np.where(is_flat, 1.0, c.precision)
        return Unknowns(c.low - at, c.high - at, c.center - at, precision, self.effect)

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
        errors: Hypotheses of the errors.
        draws: Draws of u - ``origin``.
        aliases: Effects that are left out since parameters do the same.
    """

    errors: Processes
    draws: Draws
    aliases: tuple[str, ...]

    def whitened(self, rows: Array, fold: NDArray[np.int64]) -> Array:
        """Return rows (N, k) whitened by the likeliest error of each channel.

        Args:
            rows: Rows in units.
            fold: Part of each number, shape (N,), with errors of its own.
        """
        m, draws = self.measurements, self.draws
        chosen = np.array([np.bincount(h).argmax() for h in draws.errors.T])
        size = [
            np.sqrt(np.mean(own[h == best] ** 2))
            for own, h, best in zip(draws.size.T, draws.errors.T, chosen, strict=True)
        ]
        white = whitened(rows, self.errors, m, chosen, fold)
        return white / np.array(size)[m.channel, None]


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
    doubtful = [e for e in beside if e.scope == "campaign"]
    fit, unit = _searched(bare, own, seed)
    linear = _beside(_with(bare, doubtful), fit, unit, own)
    told, aliases = _told(linear, own.alias)
    if len(told) < len(doubtful):
        doubtful = told
        linear = linear.of(_with(bare, told), fit)
    m, c = linear.measurements, linear.rival.coordinates
    share = 1.0 if known_sd is None else ((known_sd[m.channel] / unit) ** 2).min()
    errors = own.errors(m, float(share))
    filters = Filters(errors, m, 0 * m.trial, m.channel)
    there, some = np.zeros(len(doubtful), dtype=bool), bare
    for again in range(own.linearized):
        known: list[float | None] = [None] * filters.num_groups
        if known_sd is not None:
            known = [*(known_sd / linear.sizes)]
        given = filters.grams(linear.rows), errors, linear.unknowns, known, rng
        sampler = Sampler(*given, own.sampler)
        draws = sampler.draws(own.sampler.few)
        before, there = there, draws.present.mean(0) > own.likely
        free = np.append(there, True)[linear.effect]
        u = linear.origin + np.where(free, draws.u.mean(0), 0.0)
        u, is_new = np.clip(u, c.low, c.high), bool((there != before).any())
        move = np.abs(u - linear.model.u) / (draws.u.std(0) + own.step)
        is_near = not is_new and move.max() < own.moved
        if is_near or again == own.linearized - 1:
            break
        if is_new:
            some = _with(bare, [e for e, k in zip(doubtful, there, strict=True) if k])
            fit, unit = _settled(some, u[free], linear.unit, own)
            linear = linear.around(fit, free, unit, own.tried)
        else:
            fit = linearize(some, u[free], linear.unit)
            fit = centered(some, fit, linear.unit)
            linear = linear.around(fit, free, linear.unit)
    draws = sampler.draws(own.sampler.many)
    return Fitted(**vars(linear), errors=errors, draws=draws, aliases=aliases)


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


def _with(bare: Rival, effects: Sequence[Effect]) -> Rival:
    """Return a rival with some effects."""
    key = ModelKey(tuple(e.name for e in effects))
    return replace(bare, key=key, effects=effects)


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
    return _settled(bare, best_fit(bare, u, unit, fit).u, unit, own)


def _settled(
    rival: Rival, u: Array, unit: Array, settings: IdentifySettings
) -> tuple[LinearModel, Array]:
    """Return a best fit in which every channel is weighed by its own residual."""
    model = polished(rival, u, unit, settings.fit)
    for _ in range(settings.rounds):
        sizes = _sizes(rival, model.residual * unit, settings)
        if np.log(unit / sizes).mean() < settings.worth:
            break
        unit = sizes
        model = polished(rival, model.u, unit, settings.fit)
    return model, unit


def _sizes(rival: Rival, residual: Array, settings: IdentifySettings) -> Array:
    """Return the root mean square of each number's channel, shape (N,)."""
    m = rival.simulator.measurements
    rms = np.sqrt(m.by_channel(residual**2))
    return np.maximum(rms[m.channel], settings.smallest * rival.spread)


def _beside(
    whole: Rival, bare: LinearModel, unit: Array, settings: IdentifySettings
) -> Linear:
    """Return a model with effects that are absent so far, at the fit without."""
    columns, effect = whole.coordinates.places, np.full(whole.dim, -1)
    null = np.full(whole.dim, np.nan)
    for k, own in enumerate(whole.effects):
        effect[columns[own.name]] = k
        null[effect == k] = at_null(whole, own, settings.tried)[0]
    found = Linear(whole, effect, null, unit, bare)
    return found.around(bare, effect < 0, unit, settings.tried)


def _told(found: Linear, least: float) -> tuple[list[Effect], tuple[str, ...]]:
    """Return the effects that no change of the parameters imitates, and the others.

    Those that change nothing are neither.
    """
    jacobian, effect = found.model.jacobian, found.effect
    basis = basis_of(jacobian[:, effect < 0])
    left = jacobian - basis @ (basis.T @ jacobian)
    own, whole = (
        np.sqrt(np.bincount(effect + 1, (part**2).sum(0))[1:])
        for part in (left, jacobian)
    )
    effects, is_told = found.rival.effects, own > least * whole
    is_alias = ~is_told & (whole > 0)
    aliases = [e.name for e, alias in zip(effects, is_alias, strict=True) if alias]
    told = [e for e, own in zip(effects, is_told, strict=True) if own]
    return told, (*aliases,)


@dataclass(frozen=True)
class Spread:
    """The disagreement between parts of the trials.

    Attributes:
        p_value: p-value of each parameter being the same in all parts, shape (d,).
        deviation: Deviation of the parts from their mean, as far as it is none of their
            errors, shape (f, d), such that normal multiples of them add up to the
            spread.
        sd: Standard deviation of each parameter by all trials if it had no bounds,
            shape (d,).
    """

    p_value: Array
    deviation: Array
    sd: Array

    def widen(self, u: Array, by: float, rng: np.random.Generator) -> Array:
        """Return draws (n, d) as far off as the parts are from each other, times by."""
        weight = rng.standard_normal((len(u), len(self.deviation)))
        return u + by * weight @ self.deviation


def spread(found: Fitted, fewest: int) -> Spread:
    """Return the disagreement of parts of the trials about theta.

    Args:
        found: The model, linear.
        fewest: Number of parts at least.
    """
    draws, m, own = found.draws, found.measurements, found.rival.theta_dim
    likely = np.append(draws.present.mean(0) > 0.5, True)
    free = (found.rival.coordinates.trial_of() < 0) & likely[found.effect]
    parts = parts_of(m, fewest, fewest)
    white = found.whitened(found.rows[:, np.append(True, free)], parts)
    each = [white[parts == f] for f in range(int(parts.max()) + 1)]
    grams = np.stack([rows.T @ rows for rows in each])
    precision, linear = grams[:, 1:, 1:], -grams[:, 1:, 0]
    total = precision.sum(0)
    ridge = np.diag(1e-6 * np.diag(total) + 1e-12)
    best = np.linalg.solve(total + ridge, linear.sum(0))
    cov = np.linalg.inv(precision + ridge)
    each = best + np.einsum("fij,fj->fi", cov, linear - precision @ best)
    each, sd = each[:, :own], np.sqrt(np.einsum("fii->fi", cov))[:, :own]
    weight = 1 / sd**2
    mean = (weight * each).sum(0) / weight.sum(0)
    square, freedom = (weight * (each - mean) ** 2).sum(0), len(each) - 1
    of_parts = weight.sum(0) - (weight**2).sum(0) / weight.sum(0)
    variance = np.maximum(square - freedom, 0.0) / np.maximum(of_parts, 1e-300)
    # Deviations that are far off by their errors count less.
    off = np.sqrt(weight) * (each - mean)
    off = off / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    p_value = chi2.sf(square, max(freedom, 1))
    whole = np.sqrt(np.diag(np.linalg.inv(total + ridge)))[:own]
    return Spread(p_value, off * np.sqrt(variance), whole)
