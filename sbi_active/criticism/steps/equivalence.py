"""Effects that no permitted action separates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import NONE
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.further_trials import conditions_at, together
from sbi_active.criticism.rivals.noise_grid import declared_noise
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.seeding import derive_seed, forked_generators

Array = NDArray[Any]

MAX_ACTIONS = 48
NUM_THETA = 6
#: Share of the parameters at which two effects must look the same.
AGREEMENT = 0.8
#: Squared distance, in noise units over all actions, of two effects that look the same.
SAME = 1.0
#: Share of an effect's size that may be left of it for the effects to look the same.
RELATIVE = 1e-2
#: Step from the null, in deviations of the prior.
STEP = 1e-4


def equivalent_effects(
    rivals: RivalSet, actions: ActionSpace | None
) -> tuple[frozenset[str], ...]:
    r"""Return groups of effects whose predictions can be told apart by no action.

    To first order at the null an effect changes the predictions by :math:`\phi d_e`,
    and the parameters make up for all within the span of :math:`\partial f / \partial
    \theta`. Two effects are equivalent if what is left of one, over all permitted
    actions, is a multiple of what is left of the other; with "none" if nothing is left.

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
    for u in coordinates.sample(NUM_THETA, seed=derive_seed(rivals.seed, "theta")):
        left = _left_over(simulator, coordinates, u, effects, unit, rivals)
        votes += _alike(left, local)
    same = (votes[0] >= AGREEMENT * votes[1]) & (votes[1] > NUM_THETA / 2)
    names = [NONE, *[e.name for e in effects]]
    return _groups(names, same)


def noise_unit(rivals: RivalSet, simulator: TrialSimulator) -> Array:
    """Return what counts as large in each number of some trials, shape (N,)."""
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
    """Return which pairs (none first) have the same direction, and which can be told.

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
