"""Effects that no permitted action separates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.results import NONE
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.further_trials import conditions_at, together
from sbi_active.criticism.rivals.noise_grid import declared_noise
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.seeding import derive_seed, forked_generators

Array = NDArray[Any]

#: Effects of a library whose pairs are all compared, and that are all fitted.
MANY = 24
#: A choice: of a list that is longer, or a box, so many actions stand for all.
MAX_ACTIONS = 48
NUM_THETA = 6  # a choice: five of six agree by the share below
#: Share of the parameters at which two effects must look the same.
AGREEMENT = 0.8
#: Squared distance, in noise units over all actions, of two effects that look the same.
SAME = 1.0
#: Share of an effect's size that may be left of it for the effects to look the same.
RELATIVE = 1e-2
#: Step from the null, in deviations of the prior.
STEP = 1e-4
#: Steps at which an effect must leave nothing too, to be none: one that is flat at its
#: null, such as a dead zone or a lag held over a step, shows there alone.
FAR = (0.3, 1.0)
#: Steps of a search for parameters that imitate such an effect.
NUM_SEARCH = 6
#: Share of the rest from which a step has not lowered it.
ENDED = 0.99
#: Distance, in noise units, at which a search has found what it looked for.
FOUND = 1e-4
#: Parameters at which a pair that is alike near its null is compared far from it.
NUM_FAR = 2


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
    trials = rivals.trials if actions is None else every_action(rivals, actions)
    simulator = TrialSimulator(
        rivals.simulator.model, trials, seed=derive_seed(rivals.seed, "equivalence")
    )
    unit = noise_unit(rivals, simulator)
    effects = [e for e in rivals.effects.values() if e.hook != "noise"]
    votes = np.zeros((2, len(effects) + 1, len(effects) + 1))
    coordinates = SearchCoordinates(rivals.prior, (), (), len(trials))
    local = [bool(e.null_phi(1).isfinite().all()) for e in effects]
    every_u = coordinates.sample(NUM_THETA, seed=derive_seed(rivals.seed, "theta"))
    for u in every_u:
        left = _left_over(simulator, coordinates, u, effects, unit, rivals)
        vote = _alike(left, local)
        for i, effect in enumerate(effects, 1):
            lost = votes[1, 0, i] - votes[0, 0, i] > (1 - AGREEMENT) * NUM_THETA
            if lost:  # whatever the other parameters say
                vote[0, 0, i] = vote[0, i, 0] = 0.0
            elif local[i - 1] and vote[0, 0, i]:
                size = left[i - 1][1]
                near = _Neighborhood(simulator, coordinates, u, unit, rivals)
                vote[0, 0, i] = vote[0, i, 0] = float(near.hides(effect, size))
        votes += vote
    same = (votes[0] >= AGREEMENT * votes[1]) & (votes[1] > NUM_THETA / 2)
    for i, j in zip(*np.nonzero(np.triu(same, 1)), strict=True):
        one, other = effects[i - 1], effects[j - 1]
        if i > 0 and rivals.is_smooth:  # else a search would find the jumps
            same[i, j] = same[j, i] = all(
                _imitates(a, b, simulator, rivals, coordinates.to_z(u[None]), unit)
                for a, b in ((one, other), (other, one))
                for u in every_u[:NUM_FAR]
            )
    names = [NONE, *[e.name for e in effects]]
    return _groups(names, same)


def noise_unit(rivals: RivalSet, simulator: TrialSimulator) -> Array:
    """Return the size that counts as large in each number of trials, shape (N,)."""
    noise = declared_noise(rivals.model.noise, simulator.measurements)
    unit = noise.typical_sd
    if rivals.model.noise is None:
        unit = np.full(len(unit), np.median(rivals.spread))
    return unit


def _left_over(
    simulator: TrialSimulator,
    coordinates: SearchCoordinates,
    u: Array,
    effects: Sequence[Effect],
    unit: Array,
    rivals: RivalSet,
) -> list[tuple[Array, float]]:
    """Return each effect's direction that no parameter imitates, and its size."""
    step = max(rivals.step, STEP)
    sign = np.where(u + step > coordinates.high, -1.0, 1.0)
    points = np.concatenate([u[None], u + step * np.diag(sign)])
    mean = simulator.predict(*coordinates.split(points))[0] / unit
    mean = np.where(np.isfinite(mean), mean, 0.0)
    jacobian = ((mean[1:] - mean[0]) / step).T
    basis, size, _ = np.linalg.svd(jacobian, full_matrices=False)
    basis = basis[:, size > 1e-9 * max(size.max(), 1e-300)]
    left = []
    for effect in effects:
        theta, phi = coordinates.split(u[None])
        shift, scale = _small(effect, step)
        phi[effect.name] = shift
        moved = simulator.predict(theta, phi)[0][0] / unit
        change = (np.where(np.isfinite(moved), moved, 0.0) - mean[0]) / scale
        rest = change - basis @ (basis.T @ change)
        left.append((rest, float(np.linalg.norm(change))))
    return left


class _Neighborhood:
    """Predictions near some parameters u, in noise units."""

    def __init__(
        self,
        simulator: TrialSimulator,
        coordinates: SearchCoordinates,
        u: Array,
        unit: Array,
        rivals: RivalSet,
    ) -> None:
        self.simulator, self.coordinates, self.u = simulator, coordinates, u
        self.unit, self.step = unit, max(rivals.step, STEP)
        # Where the simulator jumps, a search for parameters finds the jumps.
        self.num_search = NUM_SEARCH if rivals.is_smooth else 1

    def hides(self, effect: Effect, size: float) -> bool:
        """Return whether parameters make up for an effect away from its null, too.

        Args:
            effect: Effect of which nothing is left near the null.
            size: Size of its change there, for a deviation of the prior.
        """
        if self.num_search == 1 and size > 0:  # its direction says enough
            return True
        for far in FAR:
            shift, scale = _small(effect, far)
            if not np.isfinite(effect.log_prob(shift).numpy()).all():
                continue
            moved = self._predict(self.u[None], effect, shift)[0]
            own = self._predict(self.u[None])[0]
            both = np.isfinite(moved) & np.isfinite(own)
            whole = float(np.linalg.norm((moved - own)[both])) / scale
            rest, is_free, _ = self.rest(moved, both)
            left = float(np.linalg.norm(rest)) / scale
            nothing = left**2 < SAME and left < RELATIVE * whole
            if whole > 0 and is_free and not nothing:
                return False
        return True

    def rest(self, aim: Array, both: NDArray[np.bool_]) -> tuple[Array, bool, bool]:
        """Return the rest of predictions that parameters leave, by Gauss-Newton steps.

        It also returns whether they were free, since at an edge of the prior the edge
        may be what stands against them; and whether the search has ended, so that no
        step promises more.
        """
        low, high = self.coordinates.low, self.coordinates.high
        v = self.u
        rest, has_ended = (aim - self._predict(v[None])[0])[both], False
        for _ in range(self.num_search):
            sign = np.where(v + self.step > high, -1.0, 1.0)
            points = np.concatenate([v[None], v + self.step * np.diag(sign)])
            mean = self._predict(points)
            slope = ((mean[1:] - mean[0]) / self.step * sign[:, None]).T[both]
            slope = np.where(np.isfinite(slope), slope, 0.0)
            move = np.linalg.lstsq(slope, rest, rcond=1e-9)[0]
            if self.num_search == 1:  # to first order
                return rest - slope @ move, True, True
            for share in (1.0, 0.5, 0.25, 0.125):
                to = np.clip(v + share * move, low, high)
                after = (aim - self._predict(to[None])[0])[both]
                if np.linalg.norm(after) < np.linalg.norm(rest):
                    has_ended = bool(
                        np.linalg.norm(after) > ENDED * np.linalg.norm(rest)
                    )
                    v, rest = to, after
                    break
            else:
                promised = np.linalg.norm(rest - slope @ move)
                has_ended = bool(promised > 0.5 * np.linalg.norm(rest))
                break
            if np.linalg.norm(rest) < FOUND:
                break
        return rest, bool(((v > low) & (v < high)).all()), has_ended

    def _predict(
        self, u: Array, effect: Effect | None = None, shift: Any = None
    ) -> Array:
        theta, phi = self.coordinates.split(u)
        if effect is not None:
            phi[effect.name] = shift
        return self.simulator.predict(theta, phi)[0] / self.unit


def _imitates(
    one: Effect,
    other: Effect,
    simulator: TrialSimulator,
    rivals: RivalSet,
    theta: Array,
    unit: Array,
) -> bool:
    """Return whether an effect and parameters imitate another away from its null.

    Args:
        one: Effect that imitates.
        other: Effect that is imitated.
        simulator: Simulator of the permitted actions.
        rivals: The models.
        theta: Parameters beside the other, shape (1, theta_dim).
        unit: Size that counts as large in each number.
    """
    own = SearchCoordinates(rivals.prior, (one,), (), len(simulator))
    for far in FAR:
        shift, scale = _small(other, far)
        start = _small(one, far)[0]
        inside = torch.cat([other.log_prob(shift), one.log_prob(start)])
        if not bool(inside.isfinite().all()):
            continue
        u = own.from_z(np.concatenate([theta, start.numpy()], 1))[0]
        near = _Neighborhood(simulator, own, u, unit, rivals)
        told = torch.from_numpy(theta)
        aim = simulator.predict(told, {other.name: shift})[0][0] / unit
        bare = simulator.predict(told, {})[0][0] / unit
        both = np.isfinite(aim) & np.isfinite(bare)
        whole = float(np.linalg.norm((aim - bare)[both])) / scale
        rest, is_free, has_ended = near.rest(aim, both)
        left = float(np.linalg.norm(rest)) / scale
        nothing = left**2 < SAME and left < RELATIVE * whole
        if whole > 0 and is_free and has_ended and not nothing:
            return False
    return True


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


def _groups(names: list[str], same: NDArray[Any]) -> tuple[frozenset[str], ...]:
    groups: list[set[str]] = []
    for i, name in enumerate(names):
        joined = {name} | {names[j] for j in np.flatnonzero(same[i])}
        for group in [g for g in groups if g & joined]:
            groups.remove(group)
            joined |= group
        groups.append(joined)
    return tuple(frozenset(g) for g in groups if len(g) > 1)


def every_action(rivals: RivalSet, actions: ActionSpace) -> Trials:
    """Return the trials at hand and one of every permitted action, in random order."""
    values = actions.listed()
    if values is None or len(values) > MAX_ACTIONS:
        values = actions.sample((MAX_ACTIONS,), seed=derive_seed(rivals.seed, "every"))
    order = np.random.default_rng(rivals.seed).permutation(len(values))
    own = rivals.trials
    template, first = own.template()
    times = own.sample_times
    if times is not None and times.ndim == 2:
        assert first is not None
        times = torch.cat([times, first.expand(len(values), -1)])
    conditions = together(own, conditions_at(rivals.model, own, values[order]))
    every = Trials(
        torch.cat([own.action, values[order].double()]),
        torch.cat([own.x, template.expand(len(values), *template.shape)]),
        index=torch.cat(
            [own.index, own.index.max() + 1 + torch.arange(len(values)).double()]
        ),
        sample_times=times,
        **conditions,
    )
    every.action_is_label = own.action_is_label
    return every
