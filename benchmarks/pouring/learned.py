"""What campaigns on a bank know of each action and summary."""

from __future__ import annotations

import pickle
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import Rows, read_parts
from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    doubted,
    observed,
    thumbnails,
)
from benchmarks.pouring.power import cross_validated
from benchmarks.pouring.reference import abc_log_prob
from sbi_active.seeding import forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of, mesh_coverage

__all__ = [
    "Earlier",
    "Learned",
    "ByAction",
    "by_nearest",
    "kept",
    "learn",
    "looked_at",
    "summarized",
]

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
        num: Pours behind it.
        told: Log posterior density of each left-out pour's theta, shape (num,).
        mass: Of what is denser, shape (num,).
        mean: Of thumbnails, shape (900,), where the summary is components.
        axes: Shape (900, k).
    """

    likelihood: ImageLikelihood
    num: int
    told: np.ndarray
    mass: np.ndarray
    mean: np.ndarray
    axes: np.ndarray

    def seen(self, image: Tensor, delta: int) -> Any:
        """Return what the likelihood takes of an image (22500,)."""
        mesh, small = looked_at(image[None])
        summary = np.sqrt(mesh) if delta else (small - self.mean) @ self.axes
        return observed(self.likelihood, summary[0], not mesh.any())


@dataclass(frozen=True)
class ByAction:
    """Likelihoods of their own for each action and summary.

    Attributes:
        learned: By delta and action.
        actions: Shape (a, 3).
    """

    learned: list[list[Learned]]
    actions: Tensor

    def gains(
        self, belief: Any, earlier: Earlier, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gains by delta and action, nats, and their errors, on common draws."""
        with forked_generators(seed):
            theta = belief.sample(torch.Size([NUM_ALL])).double().numpy()
        values = np.array(
            [
                [
                    own.likelihood.gain(
                        theta,
                        NUM_OUTER,
                        np.random.default_rng(seed),
                        earlier[delta, place],
                    )
                    for place, own in enumerate(by_action)
                ]
                for delta, by_action in enumerate(self.learned)
            ]
        )
        return values.mean(2), values.std(2) / np.sqrt(NUM_OUTER)

    def log_likelihood(
        self, theta: np.ndarray, image: Tensor, delta: int, place: int, earlier: Earlier
    ) -> np.ndarray:
        """Return log densities of an image, shape (n,), and remember it.

        Args:
            theta: Spread as the prior is, shape (n, d).
            image: Shape (22500,).
            delta: Of the summary.
            place: Of the action.
            earlier: Statistics of earlier trials, to which its own are added.
        """
        own = self.learned[delta][place]
        seen = own.seen(image, delta)
        found = own.likelihood.at(theta, seen, earlier[delta, place])
        if seen is not None and len(seen):
            earlier[delta, place].append(seen)
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


def summarized(folder: Path, task: Any) -> Iterator[tuple[Any, ...]]:
    """Yield delta, action, theta, summaries, whether empty, and components."""
    rows = read_parts(folder, PARTS)
    mesh, small = summaries_of(rows, task)
    theta = rows.theta.double().numpy()
    for action in task.actions.values:
        mine = (rows.action == action).all(1).numpy()
        if not mine.any():
            continue
        is_empty = ~mesh[mine].any(1)
        mean, axes = components(small[mine], NUM_COMPONENTS)
        both = (small[mine] - mean) @ axes, np.sqrt(mesh[mine])
        for delta, summary in enumerate(both):
            yield delta, action, theta[mine], summary, is_empty, (mean, axes)


def learn(folder: Path, task: Any) -> ByAction:
    """Return what is learned of a bank, of those actions that it has pours of."""
    found: list[list[Learned]] = [[], []]
    actions = []
    for delta, action, theta, summary, is_empty, basis in summarized(folder, task):
        fitted, told, mass = cross_validated(theta, summary, is_empty)
        found[delta].append(Learned(fitted, len(theta), told, mass, *basis))
        if not delta:
            actions.append(action)
    return ByAction(found, torch.stack(actions))


def by_nearest(folder: Path, task: Any) -> list[list[np.ndarray]]:
    """Return what nearest pours alone tell of left-out ones, by delta and action."""
    found: list[list[np.ndarray]] = [[], []]
    for delta, _, theta, summary, *_ in summarized(folder, task):
        found[delta].append(abc_log_prob(theta, summary))
    return found


def kept(bank: Path, path: Path | None) -> ByAction:
    """Return what is learned of a bank, from a file of our own where there is one."""
    if path is not None and path.exists():
        return pickle.loads(path.read_bytes())
    learned = learn(bank, get_task("pouring"))
    if path is not None:
        path.write_bytes(pickle.dumps(learned))
    return learned
