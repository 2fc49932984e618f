"""The best fit of a simulator to trajectories, and its linearization there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.trial_conditions import conditions_of_trials
from sbi_active.criticism.identification.errors import Hypotheses, grams
from sbi_active.criticism.identification.posterior import Draws, Unknowns, sample
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel

Array = NDArray[Any]

#: Draws of the prior that are screened, starts among them, and those that go on; of
#: each at least as many a parameter: the more there are, the more optima.
NUM_SCREENED, NUM_STARTS, NUM_KEPT = 40, 4, 2
SCREENED_EACH, STARTS_EACH, KEPT_EACH = 13, 1.25, 0.5
#: Trials in which effects are compared with the simulator at their null.
NUM_CHECKED = 4
#: Iterations along a secant, full ones, how often at most the channels' sizes follow,
#: and by what share they fall where they do again.
SECANT, FULL, ROUNDS, WORTH = 5, 5, 10, 0.01
#: Of finite differences, in deviations of the prior.
STEP = 1e-4
#: Share of a column that is no combination of the parameters' own, below which an
#: effect is an alias of them.
ALIAS = 0.02
#: Deviations of the prior by which an effect is tried.
TRIED = 0.05
#: Times that the model is linearized anew, and a move that is worth it, in posterior
#: deviations.
LINEARIZED, MOVED = 6, 0.3
#: Sweeps of the sampler before the last, and then.
FEW, MANY = 15, 40
#: Probability from which an effect is fitted.
LIKELY = 0.1
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

    @property
    def mean(self) -> Array:
        """Posterior mean, effects that are hardly there at their null, shape (d,)."""
        mean, null = self.u + self.draws.u.mean(0), _null(self.rival)
        share = self.draws.present.mean(0)
        for k, place in enumerate(_effects(self.rival)):
            if share[k] <= LIKELY:
                mean[place] = null[place]
        c = self.rival.coordinates
        return np.clip(mean, c.low, c.high)

    @property
    def move(self) -> Array:
        """From where it is linear to its mean, in posterior deviations, shape (d,)."""
        return np.abs(self.mean - self.u) / (self.draws.u.std(0) + 1e-12)


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
    some = torch.arange(min(NUM_CHECKED, len(trials)))
    with forked_generators(seed, "check"):
        theta = prior.sample(torch.Size([len(some)]))
    run = conditions_of_trials(trials, some, model)
    check = (theta, trials.action[some].to(theta.dtype), run)
    augmented = AugmentedSimulator(model, beside, check=check, next_index=index)
    simulator = TrialSimulator(augmented, trials, seed=seed)
    if not simulator.measurements.has_time or not len(simulator.measurements):
        raise ValueError(
            "expected trajectories with sample times; got outcomes without a time "
            "axis, or none; give sample_times to the simulator or the trials, or use "
            "Campaign"
        )
    channel = simulator.measurements.channel
    x = simulator.measurements.x
    num = int(np.prod(trials.x.shape[2:]))
    if lost := [c for c in range(num) if not (channel == c).any()]:
        raise ValueError(
            f"expected some measured numbers in every channel; got none in channel "
            f"{lost[0]}; leave it out of x"
        )
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

    bare, whole = rival(()), rival(doubtful)
    u, unit = _searched(bare, spread, seed)
    lift = _Lift.of(bare, whole)
    aliases = _aliases(whole, lift(u), unit)
    if aliases:
        doubtful = [e for e in doubtful if e.name not in aliases]
        whole = rival(doubtful)
        lift = _Lift.of(bare, whole)
    share = 1.0
    if known_sd is not None:
        share = float(((known_sd[channel] / unit) ** 2).min())
    found = Fitted(
        whole,
        lift(u),
        np.empty((0, 0)),
        unit,
        _unknowns(whole, lift(u)),
        Hypotheses.of(simulator.measurements, share),
        Draws.none(whole.dim),
        tuple(aliases),
    )
    there: list[str] = []
    for again in range(LINEARIZED):
        last = again == LINEARIZED - 1
        found = _linearized(found, known_sd, rng, few=True)
        share = found.draws.present.mean(0)
        before = there
        there = [e.name for e, p in zip(doubtful, share, strict=True) if p > LIKELY]
        if there != before:
            own = rival([e for e in doubtful if e.name in there])
            lift = _Lift.of(own, whole)
            u, unit = _improved(own, lift.back(found.mean)[None], found.unit)
            found = replace(found, u=lift(u), unit=unit)
        elif last or found.move.max() < MOVED:
            break
        else:
            found = replace(found, u=found.mean)
    return _linearized(found, known_sd, rng, few=False)


@dataclass(frozen=True)
class _Lift:
    """From the coordinates of a model to those of one with more effects, and back.

    Attributes:
        null: Of the larger model, with its effects at their null, nearly, shape (d,).
        shared: Places that the smaller one has, in its order.
    """

    null: Array
    shared: NDArray[np.intp]

    @classmethod
    def of(cls, small: Rival, large: Rival) -> _Lift:
        shared = np.ones(large.dim, dtype=bool)
        for effect, place in zip(large.effects, _effects(large), strict=True):
            shared[place] = effect in small.effects
        return cls(_null(large), np.flatnonzero(shared))

    def __call__(self, u: Array) -> Array:
        found = self.null.copy()
        found[self.shared] = u
        return found

    def back(self, u: Array) -> Array:
        return u[self.shared]


def _linearized(
    found: Fitted, known_sd: Array | None, rng: np.random.Generator, *, few: bool
) -> Fitted:
    """Return a fit that is linear at its u, with draws."""
    rival, unit = found.rival, found.unit
    m = rival.simulator.measurements
    step = np.full(rival.dim, STEP)
    null = _null(rival)
    for place in _effects(rival):
        # A chord where an effect is absent: many are flat at their null.
        step[place] = np.where(found.u[place] == null[place], TRIED, STEP)
    r, jacobian = rival.jacobian(found.u[None], lambda r: r / unit, step)
    rows = np.concatenate([r[0][:, None], jacobian[0]], 1)
    scale = [float(unit[m.channel == c][0]) for c in range(int(m.channel.max()) + 1)]
    known: list[float | None] = [None] * len(scale)
    if known_sd is not None:
        known = [float(sd) / s for sd, s in zip(known_sd, scale, strict=True)]
    unknowns = _unknowns(rival, found.u)
    draws = sample(
        grams(rows, m, found.hypotheses, m.trial),
        found.hypotheses,
        unknowns,
        known,
        rng,
        sweeps=FEW if few else MANY,
    )
    return replace(found, rows=rows, unknowns=unknowns, draws=draws)


def _searched(bare: Rival, spread: Array, seed: int) -> tuple[Array, Array]:
    """Return the best fit without effects, and the size of each channel's residual."""
    c = bare.coordinates
    unit = spread[bare.simulator.measurements.channel]
    dim = bare.theta_dim
    screened = max(NUM_SCREENED, SCREENED_EACH * dim)
    starts, kept = max(NUM_STARTS, STARTS_EACH * dim), max(NUM_KEPT, KEPT_EACH * dim)
    u = np.concatenate([np.zeros((1, c.dim)), c.sample(screened, seed=seed)])
    u = np.clip(u, c.low, c.high)
    r = bare.residual(u)[0] / unit
    u = u[np.argsort((r**2).sum(1))[: int(starts)]]
    rough = 0.1 * unit
    u, cost = descend(bare, u, lambda r: r / rough, STEP, SECANT, secant=True)
    return _improved(bare, u[np.argsort(cost)[: int(kept)]], unit)


def _improved(rival: Rival, u: Array, unit: Array) -> tuple[Array, Array]:
    """Return the best of some starts, every channel weighed by its own residual."""
    channel = rival.simulator.measurements.channel
    count = np.bincount(channel)

    def sizes(u: Array) -> Array:
        r = rival.residual(u)[0]
        best = r[np.argmin(((r / unit) ** 2).sum(1))]
        rms = np.sqrt(np.bincount(channel, best**2) / count)[channel]
        return np.maximum(rms, SMALLEST * rival.spread)

    unit = sizes(u)
    for again in range(ROUNDS):
        own, before = unit, np.log(unit).mean()
        u, cost = descend(rival, u, lambda r, own=own: r / own, STEP, FULL)
        u = u[[int(np.argmin(cost))]]
        unit = sizes(u)
        if again and before - np.log(unit).mean() < WORTH:
            break
    return u[0], unit


def _aliases(whole: Rival, u: Array, unit: Array) -> list[str]:
    """Return the effects that a change of the parameters imitates."""
    places = _effects(whole)
    if not places:
        return []
    _, jacobian = whole.jacobian(u[None], lambda r: r / unit, TRIED)
    jacobian = jacobian[0]
    rest = np.ones(whole.dim, dtype=bool)
    for place in places:
        rest[place] = False
    basis, triangle = np.linalg.qr(jacobian[:, rest])
    size = np.abs(np.diag(triangle))
    basis = basis[:, size > 1e-9 * max(size.max(initial=0.0), 1e-300)]
    found = []
    for effect, place in zip(whole.effects, places, strict=True):
        column = jacobian[:, place]
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) <= ALIAS * np.linalg.norm(column):
            found.append(effect.name)
    return found


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
