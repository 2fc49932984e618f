"""Sensitivity of x to parameters at a few places: derivatives, noise, rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.identifiability.formula import Combination
from sbi_active.seeding import forked_generators
from sbi_active.support import within_support

#: Returns x (n, ...) of parameters (n, theta_dim) and actions (n, action_dim), row i
#: with the same random numbers whatever the parameters; others for another key.
Simulate = Callable[[Tensor, Tensor, str], Tensor]

EPS = float(np.finfo(np.float32).eps)


@dataclass(frozen=True, kw_only=True)
class ProbeSettings:
    """Settings of the search for parameters that no action tells apart.

    Attributes:
        num_draws: Number of draws of the prior behind its deviations.
        step: Step of a derivative, in prior deviations.
        numeric: Share of the largest singular value below which one is an error of the
            differences: these are cut off at a sixth of the squared step of what turns
            within a deviation, and rounded in float32.
        trials: Trials of each action with which a parameter that is not known is hardly
            determined.
        same: Standard deviations of the noise by which x may differ at places that are
            said not to be told apart; that many trials of an action see it at one
            standard error.
        equal: Such deviations that no number of trials that is ever run sees.
        moves: Sizes of moves that are tried, in prior deviations.
        fewest_moved: Prior deviations that places lie apart to be compared at all.
        newton_steps: Number of steps back (a choice: Newton's method takes a handful
            where it converges).
        open: Deviations above which a parameter is open, as in the belief's.
        alone: Deviations above which it is said to be so by itself.
        floor: Width of a formula, in prior deviations, below which differences are no
            better.
        fewest_sets: Number of parameter sets that say anything about the others.
        most_actions: Number of actions at most (a choice).
        most_sets: Number of parameter sets at each of them (a choice).
        most_numbers: Number of derivatives that are held in memory.
    """

    num_draws: int = 2_000
    step: float = 0.01
    numeric: float = 5e-4
    trials: float = 100.0
    same: float = 0.1
    equal: float = 1e-3
    moves: tuple[float, ...] = (1.0, 0.6, 0.35, 0.2)
    fewest_moved: float = 0.25
    newton_steps: int = 30
    open: float = 0.3
    alone: float = 0.5
    floor: float = 3e-3
    fewest_sets: int = 3
    most_actions: int = 16
    most_sets: int = 32
    most_numbers: int = 8_000_000


class Sensitivities:
    """Rows at a few parameters, their noise and their derivatives."""

    def __init__(
        self,
        simulate: Simulate,
        prior: Distribution,
        actions: Tensor,
        free: Sequence[int],
        num_theta: int,
        seed: int,
        own: ProbeSettings,
    ) -> None:
        self.own = own
        self.simulate, self.prior, self.actions = simulate, prior, actions
        self.free, self.seed = list(free), seed
        with forked_generators(seed, "identifiability"):
            draws = prior.sample(torch.Size([own.num_draws])).float()
        self.draws = draws.double().numpy()
        self.deviation = self.draws.std(0)
        steps = torch.from_numpy(np.diag(own.step * self.deviation)).float()
        inside = within_support(prior, draws)
        for i in self.free:
            inside &= within_support(prior, draws + steps[i])
            inside &= within_support(prior, draws - steps[i])
        order = (~inside).to(torch.int8).argsort(stable=True)
        self.theta = draws[order[:num_theta]]
        self.base = self.x(self.theta)
        self.noise = self._noise()
        self.jacobian = np.stack([self._slope(steps[i]) for i in self.free], -1)

    def x(self, theta: Tensor, key: str = "x") -> Array:
        """Return x of all actions, shape (k, a, numbers)."""
        k, a = len(theta), len(self.actions)
        rows = theta.repeat_interleave(a, 0), self.actions.repeat(k, 1)
        x = self.simulate(*rows, key).double().reshape(k, a, -1).numpy()
        return np.where(np.isfinite(x), x, np.nan)

    def _noise(self) -> Array:
        """Return sizes that count as large, by action and number, (1, a, numbers)."""
        gap = self.base - self.x(self.theta, "noise")
        with np.errstate(invalid="ignore"):
            noise = np.sqrt(0.5 * _mean(gap**2, 0))
            spread = np.sqrt(_mean((self.base - _mean(self.base, (0, 1))) ** 2, (0, 1)))
        noise = np.where(noise > 0, noise, 1e-3 * spread)
        return np.where(noise > 0, noise, 1.0)

    def _slope(self, step: Tensor) -> Array:
        """Return the derivative along one parameter, noise units a deviation."""
        up, down = self.theta + step, self.theta - step
        gap = (up.double() - down.double()).numpy() / self.deviation
        change = (self.x(up) - self.x(down)) / self.noise
        slope = change / gap.sum(1)[:, None, None]
        return np.where(np.isfinite(slope), slope, 0.0)

    @property
    def rounding(self) -> Array:
        """Return by how much x is off, as x and theta have 24 bits, (k, a, numbers)."""
        size = np.abs(self.theta.double().numpy() / self.deviation)[:, self.free]
        moved = np.einsum("kaqi,ki->kaq", np.abs(self.jacobian), size) * self.noise
        return EPS * (10 * np.abs(np.nan_to_num(self.base)) + 2 * moved)

    def singular(self) -> tuple[Array, Array]:
        """Return singular values, 0 where they are errors, (k, d), and vectors."""
        d = len(self.free)
        stacked = self.jacobian.reshape(len(self.theta), -1, d)
        _, size, vectors = np.linalg.svd(stacked, full_matrices=True)
        size = np.pad(size, ((0, 0), (0, d - size.shape[1])))
        off = np.sqrt(((self.rounding / self.noise) ** 2).sum((1, 2))) / self.own.step
        limit = np.maximum(self.own.numeric * size.max(1), off)
        return np.where(size > limit[:, None], size, 0.0), vectors.swapaxes(1, 2)

    def covariances(self, practical: bool) -> Array:
        """Return covariances that many trials leave, in prior deviations, (k, d, d)."""
        size, vectors = self.singular()
        largest = np.maximum(size.max(1, keepdims=True), 1e-300)
        known = (size / (self.own.numeric * largest)) ** 2
        if practical:
            known = np.minimum(known, self.own.trials * size**2)
        information = (vectors * known[:, None, :]) @ vectors.swapaxes(1, 2)
        prior = np.corrcoef(self.draws[:, self.free].T) + 1e-9 * np.eye(len(self.free))
        return np.linalg.inv(np.linalg.inv(prior) + information)

    def same(
        self, up: Tensor, down: Tensor | None = None, share: float = 1.0
    ) -> tuple[bool, bool]:
        """Return whether x is about, and exactly, the same at two parameter sets.

        Args:
            up: Parameters of one.
            down: Parameters of the other; None are the first.
            share: Share of the noise that may lie between them.
        """
        x, base = self.x(up), self.base if down is None else self.x(down)
        if not (np.isnan(x) == np.isnan(base)).all():
            return False, False
        gap = np.nan_to_num(np.abs(x - base)) - 2 * self.rounding
        about, exactly = (
            bool((gap <= share * size * self.noise).all())
            for size in (self.own.same, self.own.equal)
        )
        return about, exactly


def _mean(values: Array, axis: Any) -> Array:
    """Return the mean of the numbers that are there, the axes kept; 0 without any."""
    there = np.isfinite(values)
    count = there.sum(axis, keepdims=True)
    return np.where(there, values, 0.0).sum(axis, keepdims=True) / np.maximum(count, 1)


def moved_along(
    probe: Sensitivities,
    indices: Sequence[int],
    group: Sequence[Combination],
    turn: int,
) -> Tensor | None:
    """Return parameters far from the first at which the combinations are the same."""
    rng = np.random.default_rng([probe.seed, turn])
    theta, at = probe.theta.double().numpy(), list(indices)
    scale = probe.deviation[at]
    result = probe.theta.clone()

    def values(rows: Array) -> Array:
        each = [combination.coordinate(rows) for combination in group]
        return np.array(each).reshape(len(group), len(rows)).T

    def gradient(rows: Array) -> Array:  # in prior deviations
        found = np.zeros((len(rows), len(group), len(at)))
        for row, combination in enumerate(group):
            for term in combination.terms:
                found[:, row, at.index(term.index)] = term.weight * term.slope(rows)
        return np.where(np.isfinite(found), found, 0.0) * scale

    for _ in range(3):  # other directions for those that found no place inside
        direction = rng.standard_normal((len(theta), len(at)))
        slope = gradient(theta)
        direction -= _shortest(slope, np.einsum("kgi,ki->kg", slope, direction))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-300
        for size, sign in product(probe.own.moves, (1.0, -1.0)):
            tried = theta.copy()
            tried[:, at] += sign * size * direction * scale
            with np.errstate(all="ignore"):
                for _ in range(probe.own.newton_steps if group else 0):
                    gap = values(tried) - values(theta)
                    tried[:, at] -= _shortest(gradient(tried), gap) * scale
            rows = torch.from_numpy(np.nan_to_num(tried)).float()
            inside = within_support(probe.prior, rows)
            inside &= torch.from_numpy(np.isfinite(tried).all(1))
            inside &= (result == probe.theta).all(dim=1)
            result = torch.where(inside[:, None], rows, result)
    steps = (result - probe.theta).double().numpy() / probe.deviation
    far = np.median(np.linalg.norm(steps, axis=1)) > probe.own.fewest_moved
    return result if far else None


def _shortest(gradient: Array, gap: Array) -> Array:
    """Return the shortest steps that change combinations by some, (k, g) -> (k, d)."""
    return np.einsum("kig,kg->ki", np.linalg.pinv(gradient), gap)
