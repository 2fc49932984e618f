"""The best fit of a simulator to trajectories, and its linearization there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.least_squares import descend
from sbi_active.criticism.identification.errors import Hypotheses, grams
from sbi_active.criticism.identification.posterior import Draws, Unknowns, sample
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.simulation import SimulatorModel

Array = NDArray[Any]

#: Draws of the prior that are screened, starts among them, and those that go on.
NUM_SCREENED, NUM_STARTS, NUM_KEPT = 40, 4, 2
#: Iterations along a secant, full ones, and how often the channels' sizes follow.
SECANT, FULL, ROUNDS = 5, 5, 3
#: Of finite differences, in deviations of the prior.
STEP = 1e-4
#: Share of a column that is no combination of the parameters' own, below which an
#: effect is an alias of them.
ALIAS = 0.02
#: Deviations of the prior by which an effect is tried.
TRIED = 0.05
#: Times that the model is linearized anew, and a move that is worth it, in posterior
#: deviations.
LINEARIZED, MOVED = 4, 0.3
#: Smallest residual that a channel is taken to have, in its own deviations.
SMALLEST = 1e-9


@dataclass(frozen=True)
class Fitted:
    """A simulator near its best fit, with posterior draws of its linear model.

    Attributes:
        rival: Of theta and the effects beside it.
        u: Where it is linear, shape (d,).
        rows: Residual there and its derivatives, in ``unit``, shape (N, 1 + d).
        unit: Root mean square residual of each number's channel, shape (N,).
        unknowns: What is known of u - ``u`` before the trials.
        hypotheses: Of the errors.
        draws: Of u - ``u``.
        aliases: Effects that are left out since parameters do the same.
    """

    rival: Rival
    u: Array
    rows: Array
    unit: Array
    unknowns: Unknowns
    hypotheses: Hypotheses
    draws: Draws
    aliases: tuple[str, ...]


def fitted(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    beside: Sequence[Effect],
    *,
    known_sd: Array | None,
    seed: int,
) -> Fitted:
    """Return a simulator near its best fit to trajectories.

    Args:
        model: With a noise of any kind, of which nothing is used.
        prior: Of theta.
        trials: That are fitted.
        beside: Effects that may be there; those of scope "trial" are.
        known_sd: Deviation of each channel's white errors, shape (c,); None estimates.
        seed: Of all draws.
    """
    rng = np.random.default_rng(seed)
    index = int(trials.index.max()) + 1
    nuisances = [e for e in beside if e.scope == "trial"]
    doubtful = [e for e in beside if e.scope == "campaign"]
    simulator = TrialSimulator(
        AugmentedSimulator(model, beside, next_index=index), trials, seed=seed
    )
    channel = simulator.measurements.channel
    x = simulator.measurements.x
    num = int(channel.max()) + 1
    spread = np.array([max(x[channel == c].std(), 1e-300) for c in range(num)])

    def rival(effects: Sequence[Effect]) -> Rival:
        return Rival(
            ModelKey(tuple(e.name for e in effects)),
            simulator=simulator,
            prior=prior,
            effects=effects,
            nuisances=nuisances,
            error=NoiseGrid([NoiseCell.of(simulator.measurements, sd=spread[channel])]),
            spread=spread[channel],
        )

    bare = rival(())
    u, unit = _searched(bare, spread, seed)
    kept, aliases = _told_apart(bare, rival, doubtful, u, unit)
    whole = bare
    if kept:
        whole = rival(kept)
        own = sum(bare.coordinates.joint.sizes)
        start = np.zeros(whole.dim)
        start[:own] = u[:own]
        start[whole.dim - (bare.dim - own) :] = u[own:]
        null = _null(whole)
        for place in _effects(whole):
            low, high = whole.coordinates.low[place], whole.coordinates.high[place]
            step = np.where(null[place] + TRIED > high, -TRIED, TRIED)
            start[place] = np.clip(null[place] + step, low, high)
        u, unit = _improved(whole, start[None], unit)
    found = Fitted(
        whole,
        u,
        np.empty((0, 0)),
        unit,
        _unknowns(whole, u),
        Hypotheses.of(simulator.measurements),
        Draws(*[np.empty(0)] * 4),
        tuple(aliases),
    )
    return _linearized(found, known_sd, rng)


def _linearized(
    found: Fitted, known_sd: Array | None, rng: np.random.Generator
) -> Fitted:
    """Return a fit that is linear where the posterior is."""
    m = found.rival.simulator.measurements
    places = _effects(found.rival)
    null = _null(found.rival)
    for again in range(LINEARIZED):
        unit = found.unit
        r, jacobian = found.rival.jacobian(
            found.u[None], lambda r, unit=unit: r / unit, STEP
        )
        rows = np.concatenate([r[0][:, None], jacobian[0]], 1)
        scale = [float(unit[m.channel == c][0]) for c in range(int(m.channel.max()) + 1)]
        known = [None if known_sd is None else sd / s for sd, s in zip(
            [None] * len(scale) if known_sd is None else known_sd, scale, strict=True)]
        unknowns = _unknowns(found.rival, found.u)
        channels = grams(rows, m, found.hypotheses, m.trial)
        draws = sample(channels, found.hypotheses, unknowns, known, rng)
        found = replace(found, rows=rows, unknowns=unknowns, draws=draws)
        mean, sd = draws.u.mean(0), draws.u.std(0) + 1e-12
        there = found.u + mean
        for k, place in enumerate(places):
            if draws.present[:, k].mean() < 0.5:
                there[place] = null[place]
        move = np.abs(there - found.u) / sd
        if again == LINEARIZED - 1 or move.max() < MOVED:
            return found
        c = found.rival.coordinates
        found = replace(found, u=np.clip(there, c.low, c.high))
    return found


def _searched(bare: Rival, spread: Array, seed: int) -> tuple[Array, Array]:
    """Return the best fit without effects, and the size of each channel's residual."""
    c = bare.coordinates
    unit = spread[bare.simulator.measurements.channel]
    u = np.concatenate([np.zeros((1, c.dim)), c.sample(NUM_SCREENED, seed=seed)])
    u = np.clip(u, c.low, c.high)
    r = bare.residual(u)[0] / unit
    u = u[np.argsort((r**2).sum(1))[:NUM_STARTS]]
    rough = 0.1 * unit
    u, cost = descend(bare, u, lambda r: r / rough, STEP, SECANT, secant=True)
    return _improved(bare, u[np.argsort(cost)[:NUM_KEPT]], unit)


def _improved(rival: Rival, u: Array, unit: Array) -> tuple[Array, Array]:
    """Return the best of some starts, every channel weighed by its own residual."""
    channel = rival.simulator.measurements.channel
    spread = rival.spread
    for _ in range(ROUNDS):
        r = rival.residual(u)[0]
        best = r[np.argmin(((r / unit) ** 2).sum(1))]
        count = np.bincount(channel)
        rms = np.sqrt(np.bincount(channel, best**2) / count)[channel]
        unit = np.maximum(rms, SMALLEST * spread)
        own = unit
        u, cost = descend(rival, u, lambda r, own=own: r / own, STEP, FULL)
        u = u[[int(np.argmin(cost))]]
    r = rival.residual(u)[0][0]
    rms = np.sqrt(np.bincount(channel, r**2) / np.bincount(channel))[channel]
    return u[0], np.maximum(rms, SMALLEST * spread)


def _told_apart(
    bare: Rival, rival: Any, effects: Sequence[Effect], u: Array, unit: Array
) -> tuple[list[Effect], list[str]]:
    """Return the effects that no change of the parameters imitates, and the others."""
    if not effects:
        return [], []
    whole = rival(effects)
    own = sum(bare.coordinates.joint.sizes)
    at = _null(whole)
    at[:own] = u[:own]
    at[whole.dim - (bare.dim - own) :] = u[own:]
    c = whole.coordinates
    at = np.clip(at, c.low, c.high)
    _, jacobian = whole.jacobian(at[None], lambda r: r / unit, TRIED)
    jacobian = jacobian[0]
    places = _effects(whole)
    rest = np.ones(whole.dim, dtype=bool)
    for place in places:
        rest[place] = False
    basis, triangle = np.linalg.qr(jacobian[:, rest])
    size = np.abs(np.diag(triangle))
    basis = basis[:, size > 1e-9 * max(size.max(initial=0.0), 1e-300)]
    kept, aliases = [], []
    for effect, place in zip(effects, places, strict=True):
        column = jacobian[:, place]
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) > ALIAS * np.linalg.norm(column):
            kept.append(effect)
        else:
            aliases.append(effect.name)
    return kept, aliases


def _effects(rival: Rival) -> list[slice]:
    """Return the places of the doubtful effects among a model's coordinates."""
    columns = rival.columns()
    return [columns[e.name] for e in rival.effects]


def _null(rival: Rival) -> Array:
    """Return the coordinates of effects at which they vanish; 0 for others, (d,)."""
    c = rival.coordinates
    z = c.to_z(np.zeros((1, rival.dim)))
    for effect, place in zip(rival.effects, _effects(rival), strict=True):
        z[0, place] = effect.null_phi(1, finite=True).numpy()[0]
    with np.errstate(divide="ignore"):
        null = np.clip(c.from_z(z)[0], c.low, c.high)
    rest = np.ones(rival.dim, dtype=bool)
    for place in _effects(rival):
        rest[place] = False
    return np.where(rest, 0.0, null)


def _unknowns(rival: Rival, u: Array) -> Unknowns:
    """Return what is known before the trials of coordinates from a point on."""
    c = rival.coordinates
    effect = np.full(rival.dim, -1)
    precision = c.precision.copy()
    for k, place in enumerate(_effects(rival)):
        effect[place] = k
        precision[place] = np.where(precision[place] > 0, precision[place], 1.0)
    null = np.where(effect >= 0, _null(rival) - u, 0.0)
    return Unknowns(c.low - u, c.high - u, c.center - u, precision, null, effect)
