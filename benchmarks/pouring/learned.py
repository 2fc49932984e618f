r"""What campaigns on a bank know of each action and summary.

The power that a belief takes a learned likelihood to, from left-out pours.

The likelihood is learned from four fifths of the pours and judged on the others: the
power w is the one at which the posterior of a left-out pour's theta,

.. math::
    p_w(\theta | x) = p(x | \theta)^w \Big/ \int p(x | \theta')^w\, p(\theta')
    \, \mathrm d\theta',

has the highest log density at the mean: 1 where the likelihood is right, 0 where it
tells nothing. The prior is uniform on [0, 1]^d.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp
from torch import Tensor

from benchmarks.pouring.bank import Rows, read_parts
from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    doubted,
    observed,
    thumbnails,
)
from sbi_active.tasks.pouring import images_of, mesh_coverage

Array = NDArray[Any]

NUM_FOLDS = 5
NUM_CELLS = 10  # along each parameter, of the grid that left-out pours are judged on
POWERS = np.linspace(0, 1.2, 13)


def grid(num: int) -> Array:
    """Return the middles of num^3 cells of [0, 1]^3, the last axis fastest."""
    line = (np.arange(num) + 0.5) / num
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)


def cross_validated(theta: Array, summary: Array, is_empty: Array) -> ImageLikelihood:
    """Return the likelihood with the power that tells left-out pours best.

    Args:
        theta: Parameters, shape (n, 3).
        summary: Summaries, shape (n, q).
        is_empty: Whether no cube is in view, shape (n,).
    """
    cells, n = grid(NUM_CELLS), len(theta)
    log_p = np.zeros((n, len(cells)))
    for k in range(NUM_FOLDS):
        out = np.arange(n) % NUM_FOLDS == k
        fitted = ImageLikelihood.fit(theta[~out], summary[~out], is_empty[~out])
        seen = [
            observed(fitted, summary[i], bool(is_empty[i])) for i in np.nonzero(out)[0]
        ]
        log_p[out] = fitted.at_each(cells, seen)
    place = np.minimum((theta * NUM_CELLS).astype(int), NUM_CELLS - 1)
    index = np.ravel_multi_index(tuple(place.T), (NUM_CELLS,) * 3)
    power = best_power(log_p, log_p[np.arange(len(log_p)), index])
    return replace(ImageLikelihood.fit(theta, summary, is_empty), power=power)


def best_power(log_p: Array, own: Array) -> float:
    """Return the power that tells left-out pours best.

    Args:
        log_p: Log likelihoods at cells of the prior, or draws from it, shape (n, m).
        own: At the truth, shape (n,).
    """
    score = [told_by(power * log_p, power * own).mean() for power in POWERS]
    return float(POWERS[int(np.argmax(score))])


def told_by(log_p: Array, own: Array) -> Array:
    """Return log density of the truth by log p at cells of the prior, (n,)."""
    return own - np.asarray(logsumexp(log_p, 1)) + np.log(log_p.shape[1])


NUM_OUTER, NUM_ALL = 100, 300  # draws behind an expected gain
NUM_COMPONENTS = 36
#: Parts of a bank that are learned from.
PARTS = ("prior", "likely")
#: Statistics of earlier trials by delta and place of the action.
Earlier = defaultdict[tuple[int, int], list[np.ndarray]]


@dataclass(frozen=True)
class Learned:
    """What one summary of an action's pours tells.

    Attributes:
        likelihood: Learned from them.
        mean: Of thumbnails, shape (900,), where the summary is components.
        axes: Shape (900, k).
    """

    likelihood: ImageLikelihood
    mean: np.ndarray
    axes: np.ndarray

    def seen(self, image: Tensor, delta: int) -> Any:
        """Return what the likelihood takes of an image (22500,)."""
        mesh, small = looked_at(image[None])
        summary = np.sqrt(mesh) if delta else (small - self.mean) @ self.axes
        return observed(self.likelihood, summary[0], not mesh.any())


@dataclass(frozen=True)
class ByAction:
    """Likelihoods for each action and summary.

    Attributes:
        learned: By delta and action.
        actions: Shape (a, 3).
        inputs: Function of parameters (n, d) and an action to what likelihoods take.
    """

    learned: list[list[Learned]]
    actions: Tensor
    inputs: Callable[[np.ndarray, Tensor], np.ndarray] = lambda theta, action: theta

    def gains(self, belief: Any, earlier: Earlier, seed: int) -> np.ndarray:
        """Return gains by delta and action, nats, on common draws and outcomes."""
        theta = belief.draws(NUM_ALL, seed)
        values = [
            [
                own.likelihood.gain(
                    self.inputs(theta, action),
                    NUM_OUTER,
                    np.random.default_rng(seed),
                    earlier[delta, place],
                )
                for place, (own, action) in enumerate(
                    zip(by_action, self.actions, strict=True)
                )
            ]
            for delta, by_action in enumerate(self.learned)
        ]
        return np.mean(values, 2)

    def log_likelihood(
        self, theta: np.ndarray, image: Tensor, delta: int, place: int, earlier: Earlier
    ) -> np.ndarray:
        """Return log densities of an image, shape (n,), and remember it.

        Args:
            theta: Parameters, spread as the prior is, shape (n, d).
            image: Image, shape (22500,).
            delta: Number of the summary.
            place: Number of the action.
            earlier: Statistics of earlier trials, to which its own are added.
        """
        own = self.learned[delta][place]
        seen, before = own.seen(image, delta), earlier[delta, place]
        known = self.inputs(theta, self.actions[place])
        found = own.likelihood.at(known, seen, before)
        if seen is not None and len(seen):
            before.append(seen)
        return doubted(found, own.likelihood.power)


def looked_at(images: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return mesh coverage (n, 36) and thumbnails (n, 900) of images (n, 22500)."""
    return mesh_coverage(images).numpy().astype(np.float64), thumbnails(images.numpy())


def summaries_of(rows: Rows, task: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return mesh coverage and thumbnails of stored pours."""
    found = [
        looked_at(images_of(rows.poses[k : k + 500], task.pours.particles))
        for k in range(0, len(rows), 500)
    ]
    mesh, small = zip(*found, strict=True)
    return np.concatenate(mesh), np.concatenate(small)


def learn(folder: Path, task: Any) -> ByAction:
    """Return what is learned of a bank, of those actions that it has pours of."""
    rows = read_parts(folder, PARTS)
    mesh, small = summaries_of(rows, task)
    theta = rows.theta.double().numpy()
    found: list[list[Learned]] = [[], []]
    actions = []
    for action in task.actions.values:
        mine = (rows.action == action).all(1).numpy()
        if not mine.any():
            continue
        actions.append(action)
        for own, one in zip(
            found, both_summaries(mesh[mine], small[mine]), strict=True
        ):
            fitted = cross_validated(theta[mine], *one[:2])
            own.append(Learned(fitted, *one[2:]))
    return ByAction(found, torch.stack(actions))


def both_summaries(mesh: np.ndarray, small: np.ndarray) -> Iterator[tuple[Any, ...]]:
    """Yield components and mesh coverage, each with emptiness, and the components."""
    is_empty = ~mesh.any(1)
    mean, axes = components(small, NUM_COMPONENTS)
    yield (small - mean) @ axes, is_empty, mean, axes
    yield np.sqrt(mesh), is_empty, mean, axes
