"""Effects that no permitted action separates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
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
from sbi_active.criticism.results import NONE
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import declared_noise
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.inference.sampling.least_squares import basis_of
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
        self.unit = np.median(rivals.spread)  # what counts as large
        if (noise := rivals.model.noise) is not None:
            own = declared_noise(noise, self.simulator.measurements)
            self.unit = own.typical_sd
        self.step = max(rivals.step, 1e-4)  # from the null, in deviations of the prior
        self.coordinates = SearchCoordinates(self.prior, (), (), len(trials))

    def predict(
        self, c: SearchCoordinates, u: Array, effect: Effect | None = None, phi: Any = 0
    ) -> Array:
        """Return predictions at u, shape (n, d), beside an effect that u has not."""
        theta, own = c.split(u)
        if effect is not None:
            own[effect.name] = phi
        return self.simulator.predict(theta, own)[0] / self.unit

    def slopes(self, c: SearchCoordinates, u: Array) -> tuple[Array, Array]:
        """Return predictions at u, shape (N,), and their derivatives, (N, d)."""
        sign = np.where(u + self.step > c.high, -1.0, 1.0)
        mean = self.predict(c, np.concatenate([u[None], u + self.step * np.diag(sign)]))
        return mean[0], ((mean[1:] - mean[0]) / self.step * sign[:, None]).T

    def left_over(
        self, u: Array, effects: Sequence[Effect]
    ) -> list[tuple[Array, float]]:
        """Return each effect's direction that no parameter imitates, and its size."""
        mean, jacobian = (
            np.where(np.isfinite(part), part, 0.0)
            for part in self.slopes(self.coordinates, u)
        )
        basis = basis_of(jacobian)
        left = []
        for effect in effects:
            shift, scale = _small(effect, self.step)
            moved = self.predict(self.coordinates, u[None], effect, shift)[0]
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
        c, start = self.coordinates, u
        own = () if one is None else (one,)
        if own:
            c = SearchCoordinates(self.prior, own, (), len(self.simulator))
        for far in FAR:
            shift, scale = _small(other, far)
            begin = [_small(effect, far)[0] for effect in own]
            each = zip((other, *own), (shift, *begin), strict=True)
            if not all(bool(e.log_prob(phi).isfinite().all()) for e, phi in each):
                continue
            if own:
                z = [self.coordinates.to_z(u[None]), *(phi.numpy() for phi in begin)]
                start = c.from_z(np.concatenate(z, 1))[0]
            aim = self.predict(self.coordinates, u[None], other, shift)[0]
            bare = self.predict(self.coordinates, u[None])[0]
            both = np.isfinite(aim) & np.isfinite(bare)
            whole = float(np.linalg.norm((aim - bare)[both])) / scale
            rest, is_free, has_ended = self._rest(c, start, aim, both)
            left = float(np.linalg.norm(rest)) / scale
            nothing = left**2 < SAME and left < RELATIVE * whole
            if whole > 0 and is_free and not nothing and (has_ended or not own):
                return False
        return True

    def _rest(
        self, c: SearchCoordinates, u: Array, aim: Array, both: NDArray[np.bool_]
    ) -> tuple[Array, bool, bool]:
        """Return the rest of predictions that parameters leave, by Gauss-Newton steps.

        It also returns whether they were free, since at an edge of the prior the edge
        may be what stands against them; and whether the search has ended, so that no
        step promises more.
        """
        rest, has_ended = (aim - self.predict(c, u[None])[0])[both], False
        # Where the simulator jumps, a search for parameters finds the jumps.
        for _ in range(6):
            slope = self.slopes(c, u)[1][both]
            slope = np.where(np.isfinite(slope), slope, 0.0)
            move = np.linalg.lstsq(slope, rest, rcond=1e-9)[0]
            if not self.is_smooth:  # to first order
                return rest - slope @ move, True, True
            size = np.linalg.norm(rest)
            for share in (1.0, 0.5, 0.25, 0.125):
                to = np.clip(u + share * move, c.low, c.high)
                after = (aim - self.predict(c, to[None])[0])[both]
                if np.linalg.norm(after) < size:
                    u, rest = to, after
                    has_ended = bool(np.linalg.norm(after) > 0.99 * size)
                    break
            else:
                has_ended = bool(np.linalg.norm(rest - slope @ move) > 0.5 * size)
                break
            if np.linalg.norm(rest) < 1e-4:  # noise units
                break
        return rest, bool(((u > c.low) & (u < c.high)).all()), has_ended


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

    A longer list, or a box, is represented by 48 actions.
    """
    values = actions.listed()
    if values is None or len(values) > 48:
        values = actions.sample((48,), seed=derive_seed(rivals.seed, "every"))
    order = np.random.default_rng(rivals.seed).permutation(len(values))
    own = rivals.trials
    index = own.index.max() + 1 + torch.arange(len(values)).double()
    return own.joined(unmeasured(rivals.model, own, values[order], index))
