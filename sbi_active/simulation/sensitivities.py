"""Sensitivity of x to parameters at a few places: derivatives, noise, rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import forked_generators
from sbi_active.support import within_support

Array = NDArray[Any]
#: Returns x (n, ...) of parameters (n, theta_dim) and actions (n, action_dim), row i
#: with the same random numbers whatever the parameters; others for another key.
Simulate = Callable[[Tensor, Tensor, str], Tensor]

STEP = 0.01  # of a derivative, in prior deviations
#: Share of the largest singular value below which one is an error of the differences:
#: these are cut off at STEP**2 / 6 of what turns within a deviation, and rounded in
#: float32.
NUMERIC = 5e-4
#: Trials of each action with which a parameter that is not known is hardly determined.
TRIALS = 100.0
#: Standard deviations of the noise by which x may differ at places that are said not to
#: be told apart; TRIALS trials of an action see that at one standard error.
SAME = 0.1
EQUAL = 1e-3  # of them, which no number of trials that is ever run sees
NUM_DRAWS = 2_000
EPS = float(np.finfo(np.float32).eps)


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
    ) -> None:
        self.simulate, self.prior, self.actions = simulate, prior, actions
        self.free, self.seed = list(free), seed
        with forked_generators(seed, "identifiability"):
            draws = prior.sample(torch.Size([NUM_DRAWS])).float()
        self.draws = draws.double().numpy()
        self.deviation = self.draws.std(0)
        steps = torch.from_numpy(np.diag(STEP * self.deviation)).float()
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
        k, d = len(self.theta), len(self.free)
        stacked = self.jacobian.reshape(k, -1, d)
        _, size, vectors = np.linalg.svd(stacked, full_matrices=True)
        size = np.pad(size, ((0, 0), (0, d - size.shape[1])))
        off = np.sqrt(((self.rounding / self.noise) ** 2).sum((1, 2))) / STEP
        limit = np.maximum(NUMERIC * size.max(1), off)
        return np.where(size > limit[:, None], size, 0.0), vectors.swapaxes(1, 2)

    def covariances(self, practical: bool) -> Array:
        """Return covariances that many trials leave, in prior deviations, (k, d, d)."""
        size, vectors = self.singular()
        largest = np.maximum(size.max(1, keepdims=True), 1e-300)
        known = (size / (NUMERIC * largest)) ** 2
        if practical:
            known = np.minimum(known, TRIALS * size**2)
        information = (vectors * known[:, None, :]) @ vectors.swapaxes(1, 2)
        prior = np.corrcoef(self.draws[:, self.free].T).reshape(2 * [len(self.free)])
        prior = prior + 1e-9 * np.eye(len(prior))
        return np.linalg.inv(np.linalg.inv(prior) + information)

    def same(self, moved: Tensor) -> tuple[bool, bool]:
        """Return whether x is about, and exactly, as at the first parameters."""
        x = self.x(moved)
        if not np.array_equal(np.isnan(x), np.isnan(self.base)):
            return False, False
        gap = np.nan_to_num(np.abs(x - self.base))
        rounding = 2 * self.rounding
        about = bool((gap <= SAME * self.noise + rounding).all())
        return about, bool((gap <= EQUAL * self.noise + rounding).all())


def _mean(values: Array, axis: Any) -> Array:
    """Return the mean of the numbers that are there, the axes kept; 0 without any."""
    there = np.isfinite(values)
    count = there.sum(axis, keepdims=True)
    return np.where(there, values, 0.0).sum(axis, keepdims=True) / np.maximum(count, 1)
