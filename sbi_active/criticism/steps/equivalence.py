"""Effects that no permitted action separates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.trial_conditions import unmeasured
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.results import NONE, ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.inference.sampling.least_squares import basis_of, descend
from sbi_active.seeding import derive_seed, forked_generators

#: Effects of a library whose pairs are all compared, and that are all fitted.
MANY = 24
#: Squared distance, in noise units over all actions, of two effects that look the same.
SAME = 1.0
#: Share of an effect's size that may be left of it for the effects to look the same.
RELATIVE = 1e-2
#: Steps at which an effect must leave nothing too, to be none: one that is flat at its
#: null, such as a dead zone or a lag held over a step, shows there alone.
FAR = (0.3, 1.0)


def is_large(effects: Collection[Effect]) -> bool:
    """Return whether a library is too large to look at all that it may confuse.

    It has more than 24 effects, or forces of the dictionary, which add up to anything.
    """
    return len(effects) > MANY or any(map(is_force, effects))


def equivalent_effects(
    rivals: RivalSet, actions: ActionSpace | None
) -> tuple[frozenset[str], ...]:
    r"""Return groups of effects whose predictions can be told apart by no action.

    To first order at the null an effect changes the predictions by :math:`\phi d_e`,
    and the parameters make up for all within the span of :math:`\partial f / \partial
    \theta`. Two effects are equivalent if what is left of one, over all permitted
    actions, is a multiple of what is left of the other; with "none" if nothing is left.

    An effect that is flat at its null leaves nothing there and may leave much further
    off. It is equivalent to "none" only if at .3 and 1 deviations of its prior, too,
    parameters are found that make up for all of it. Two effects that are alike at their
    null, as a delay and a lag are, must be so there as well: parameters and a strength
    of either are looked for that imitate the other.

    An effect with an infinite null has no derivative there: it is equivalent to "none"
    where its strongest draw shows nothing, and is not compared with others.

    Args:
        rivals: The models.
        actions: The permitted ones; None compares on the trials at hand.
    """
    # Of six parameters five must agree; far from its null a pair is compared at two.
    num_theta, agreement, num_far = 6, 0.8, 2
    trials = rivals.trials if actions is None else _every_action(rivals, actions)
    world = _World(rivals, trials)
    effects = [e for e in rivals.effects.values() if e.hook != "noise"]
    votes = np.zeros((2, len(effects) + 1, len(effects) + 1))
    local = [bool(e.null_phi(1).isfinite().all()) for e in effects]
    seed = derive_seed(rivals.seed, "theta")
    every_u = world.coordinates.sample(num_theta, seed=seed)
    for u in every_u:
        left = world.left_over(u, effects)
        vote = _alike(left, local)
        for i, effect in enumerate(effects, 1):
            lost = votes[1, 0, i] - votes[0, 0, i] > (1 - agreement) * num_theta
            if lost:  # whatever the other parameters say
                vote[0, 0, i] = vote[0, i, 0] = 0.0
            # Where the simulator jumps, the direction near the null says enough.
            near = world.is_smooth or left[i - 1][1] == 0
            if not lost and local[i - 1] and vote[0, 0, i] and near:
                vote[0, 0, i] = vote[0, i, 0] = float(world.imitates(None, effect, u))
        votes += vote
    same = (votes[0] >= agreement * votes[1]) & (votes[1] > num_theta / 2)
    for i, j in zip(*np.nonzero(np.triu(same, 1)), strict=True):
        pair = effects[i - 1], effects[j - 1]
        if i > 0 and world.is_smooth:  # else a search would find the jumps
            same[i, j] = same[j, i] = all(
                world.imitates(a, b, u)
                for a, b in (pair, pair[::-1])
                for u in every_u[:num_far]
            )
    names = np.array([NONE, *[e.name for e in effects]])
    num, group = connected_components(same, directed=False)
    found = (frozenset(names[group == g].tolist()) for g in range(num))
    return tuple(g for g in found if len(g) > 1)


class _World:
    """Predictions of trials, in noise units.

    Args:
        rivals: The models.
        trials: Trials that are predicted.
    """

    def __init__(self, rivals: RivalSet, trials: Trials) -> None:
        self.simulator = TrialSimulator(
            rivals.simulator.model, trials, seed=derive_seed(rivals.seed, "equivalence")
        )
        self.prior, self.is_smooth = rivals.prior, rivals.is_smooth
        m = self.simulator.measurements
        self.unit = np.full(len(m), np.median(rivals.spread))  # what counts as large
        if rivals.model.noise is not None:
            self.unit = rivals.noise_of(m).typical_sd
        self.step = max(rivals.step, 1e-4)  # from the null, in deviations of the prior
        self.bare = self.rival(())
        self.coordinates = self.bare.coordinates

    def rival(self, effects: Sequence[Effect], aim: Array | float = 0.0) -> Rival:
        """Return the simulator with effects, any parameters of which are as likely.

        Args:
            effects: Effects that it has.
            aim: Numbers that it is to predict, in noise units, shape (N,).
        """
        simulator, m = copy(self.simulator), self.simulator.measurements
        simulator.measurements = replace(m, x=self.unit * aim)
        rival = Rival(
            key=ModelKey(tuple(e.name for e in effects)),
            simulator=simulator,
            prior=self.prior,
            effects=effects,
            nuisances=(),
            error=NoiseGrid([NoiseCell.of(m, sd=self.unit)]),
            spread=self.unit,
            center=np.zeros(len(m)),
            step=self.step,
        )
        rival.coordinates.precision = np.zeros(rival.dim)
        return rival

    def predict(self, u: Array, effect: Effect | None = None, phi: Any = 0) -> Array:
        """Return the prediction at parameters u, shape (d,), beside an effect."""
        theta, own = self.coordinates.split(u[None])
        if effect is not None:
            own[effect.name] = phi
        return self.simulator.predict(theta, own)[0][0] / self.unit

    def left_over(
        self, u: Array, effects: Sequence[Effect]
    ) -> list[tuple[Array, float]]:
        """Return each effect's direction that no parameter imitates, and its size."""
        mean = np.nan_to_num(self.predict(u), posinf=0.0, neginf=0.0)
        slopes = self.bare.jacobian(u[None], self.bare.whitener(), self.step)[1][0]
        basis, left = basis_of(slopes), []
        for effect in effects:
            shift, scale = _small(effect, self.step)
            moved = self.predict(u, effect, shift)
            change = (np.where(np.isfinite(moved), moved, 0.0) - mean) / scale
            rest = change - basis @ (basis.T @ change)
            left.append((rest, float(np.linalg.norm(change))))
        return left

    def imitates(self, one: Effect | None, other: Effect, u: Array) -> bool:
        """Return whether parameters imitate an effect away from its null, too.

        Args:
            one: Effect that may help them; None for none.
            other: Effect that is imitated.
            u: Parameters beside it, shape (d,).
        """
        own = () if one is None else (one,)
        for far in FAR:
            shift, scale = _small(other, far)
            begin = [_small(effect, far)[0] for effect in own]
            each = zip((other, *own), (shift, *begin), strict=True)
            if not all(bool(e.log_prob(phi).isfinite().all()) for e, phi in each):
                continue
            aim, bare = self.predict(u, other, shift), self.predict(u)
            both = np.isfinite(aim) & np.isfinite(bare)
            whole = float(np.linalg.norm((aim - bare)[both])) / scale
            z = [self.coordinates.to_z(u[None]), *(phi.numpy() for phi in begin)]
            rival = self.rival(own, np.where(both, aim, 0.0))
            rest, is_free = self._rest(rival, np.concatenate(z, 1), both)
            left = float(np.linalg.norm(rest)) / scale
            nothing = left**2 < SAME and left < RELATIVE * whole
            if whole > 0 and is_free and not nothing:
                return False
        return True

    def _rest(
        self, rival: Rival, z: Array, both: NDArray[np.bool_]
    ) -> tuple[Array, bool]:
        """Return the rest of predictions that parameters leave, from some on.

        It also returns whether they were free, since at an edge of the prior the edge
        may be what stands against them.
        """
        c = rival.coordinates

        def whiten(residual: Array) -> Array:
            return np.where(both, residual / self.unit, 0.0)

        u = c.from_z(z)
        if not self.is_smooth:  # a search would find the jumps: to first order
            rest, slope = rival.jacobian(u, whiten, self.step)
            basis = basis_of(slope[0])
            return rest[0] - basis @ (basis.T @ rest[0]), True
        u, _ = descend(rival, u, whiten, self.step, 30, converged=1e-6)
        rest = whiten(rival.residual(u)[0])[0]
        return rest, bool(((u > c.low) & (u < c.high)).all())


def _small(effect: Effect, step: float) -> tuple[torch.Tensor, float]:
    """Return phi close to the null and its distance in prior deviations.

    Where the null is infinite, phi is the draw that shows most: the extreme one.
    """
    with forked_generators(0, "equivalence", effect.name):
        draws = effect.sample(500)
    null = effect.null_phi(1)
    if not bool(null.isfinite().all()):
        far = draws.min(0) if bool((null > 0).all()) else draws.max(0)
        return far.values[None], 1.0
    spread = (draws - null).square().mean(0).sqrt()
    towards = torch.sign((draws - null).median(0).values)
    towards = torch.where(towards == 0, torch.ones_like(towards), towards)
    return null + step * spread * towards, step


def _alike(left: list[tuple[Array, float]], local: list[bool]) -> Array:
    """Return masks of pairs (none first) that have the same direction, and can be told.

    At parameters where nothing is left of an effect, it tells nothing of a pair.
    """
    num = len(left) + 1
    same, told = np.eye(num), np.eye(num)
    told[0] = told[:, 0] = 1.0
    for i, (a, whole) in enumerate(left, 1):
        size = a @ a
        nothing = size < SAME and np.sqrt(size) < RELATIVE * whole
        same[0, i] = same[i, 0] = float(nothing or whole == 0)
    for i, (a, _) in enumerate(left, 1):
        size = a @ a
        for j, (b, other) in enumerate(left[i:], i + 1):
            if same[0, i] or same[0, j] or min(b @ b, other) == 0:
                continue
            told[i, j] = told[j, i] = 1.0
            if not (local[i - 1] and local[j - 1]):
                continue
            rest = a - (a @ b) / (b @ b) * b
            distance = rest @ rest
            close = distance < SAME and distance < RELATIVE**2 * size
            same[i, j] = same[j, i] = float(close)
    return np.stack([same, told])


def _every_action(rivals: RivalSet, actions: ActionSpace) -> Trials:
    """Return the trials at hand and one of every permitted action, in random order.

    Of a list that is longer, or a box, 48 actions stand for all.
    """
    values = actions.listed()
    if values is None or len(values) > 48:
        values = actions.sample((48,), seed=derive_seed(rivals.seed, "every"))
    order = np.random.default_rng(rivals.seed).permutation(len(values))
    own = rivals.trials
    index = own.index.max() + 1 + torch.arange(len(values)).double()
    return own.joined(unmeasured(rivals.model, own, values[order], index))
