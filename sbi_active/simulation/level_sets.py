"""Parameters far from others at which some combinations are the same."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.combinations.formula import Combination
from sbi_active.simulation.sensitivities import Sensitivities
from sbi_active.support import within_support

Array = NDArray[Any]

FEWEST_MOVED = 0.25  # prior deviations that places lie apart to be compared at all
MOVES = (1.0, 0.6, 0.35, 0.2)  # sizes tried, in prior deviations
NEWTON_STEPS = 30  # a choice: Newton's method takes a handful where it converges


def moved_along(
    probe: Sensitivities,
    indices: Sequence[int],
    group: Sequence[Combination],
    turn: int,
) -> Tensor | None:
    """Return parameters far from the first at which the combinations are the same."""
    rng = np.random.default_rng([probe.seed, turn])
    theta = probe.theta.double().numpy()
    at = list(indices)
    scale = probe.deviation[at]
    result = probe.theta.clone()
    for _ in range(3):  # other directions for those that found no place inside
        direction = rng.standard_normal((len(theta), len(at)))
        gradient = _gradient(theta, group, at) * scale
        direction -= _solved(gradient, np.einsum("kgi,ki->kg", gradient, direction))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-300
        for size in MOVES:
            for sign in (1.0, -1.0):
                tried = theta.copy()
                tried[:, at] += sign * size * direction * scale
                tried = _back(tried, theta, group, at, scale)
                rows = torch.from_numpy(np.nan_to_num(tried)).float()
                inside = within_support(probe.prior, rows)
                inside &= torch.from_numpy(np.isfinite(tried).all(1))
                still = (result == probe.theta).all(dim=1)
                result = torch.where((inside & still)[:, None], rows, result)
    step = (result - probe.theta).double().numpy() / probe.deviation
    far = np.sqrt((step**2).sum(1))
    return result if np.median(far) > FEWEST_MOVED else None


def _back(
    tried: Array,
    theta: Array,
    group: Sequence[Combination],
    at: list[int],
    scale: Array,
) -> Array:
    """Return the places next to some at which all combinations are as at theta."""
    if not group:
        return tried
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        aim = np.stack([c.coordinate(theta) for c in group], 1)
        for _ in range(NEWTON_STEPS):
            gap = np.stack([c.coordinate(tried) for c in group], 1) - aim
            gap = np.nan_to_num(gap, nan=np.nan, posinf=np.nan, neginf=np.nan)
            lost = np.asarray(~np.isfinite(gap).all(1))
            gap[lost], safe = 0.0, np.where(lost[:, None], theta, tried)
            tried = np.where(lost[:, None], np.nan, tried)
            gradient = _gradient(safe, group, at) * scale
            tried[:, at] -= _solved(gradient, gap) * scale
    return tried


def _gradient(theta: Array, group: Sequence[Combination], at: list[int]) -> Array:
    """Return the derivatives of combinations by parameters, shape (k, g, len(at))."""
    gradient = np.zeros((len(theta), len(group), len(at)))
    for row, combination in enumerate(group):
        for term in combination.terms:
            gradient[:, row, at.index(term.index)] = term.weight * term.slope(theta)
    return gradient


def _solved(gradient: Array, gap: Array) -> Array:
    """Return the shortest steps that change combinations by some, (k, g) -> (k, d)."""
    if not gradient.shape[1]:
        return np.zeros((len(gap), gradient.shape[2]))
    return np.einsum("kig,kg->ki", np.linalg.pinv(gradient), gap)
