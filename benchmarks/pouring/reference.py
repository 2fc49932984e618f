"""Pours around the beliefs of a target's campaigns, which these are judged by."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import ROWS_A_FILE, Drawn, Rows, fill
from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.campaign import SIDE, TEMPERED, GridBelief
from benchmarks.pouring.learned import (
    ByAction,
    Earlier,
    components,
    grid,
    learn,
    looked_at,
)
from benchmarks.pouring.likelihood import ImageLikelihood, observed
from benchmarks.pouring.run import RESULTS
from benchmarks.rows import read, resumed
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of

OUTSIDE = 0.02  # share of the pooled beliefs beyond each side of the box
NUM_CELLS = 14  # along each side of the box, of the reference
NUM_COMPONENTS = 36


@dataclass(frozen=True)
class Box:
    """Where pours are drawn, in whole cells of the belief's grid.

    Attributes:
        low: Shape (3,).
        high: Shape (3,).
    """

    low: np.ndarray
    high: np.ndarray

    @property
    def volume(self) -> float:
        """Share of the prior."""
        return float((self.high - self.low).prod())

    def cells(self) -> np.ndarray:
        """Return the middles of the reference's cells, shape (14^3, 3)."""
        return self.low + grid(NUM_CELLS) * (self.high - self.low)

    def holds(self, theta: np.ndarray) -> np.ndarray:
        """Return which of some parameters (n, 3) are inside, shape (n,)."""
        return np.asarray(((theta > self.low) & (theta < self.high)).all(1))


@dataclass(frozen=True)
class Campaign:
    """The trials of one campaign.

    Attributes:
        seed: Its.
        places: Of the actions, among those of the bank.
        deltas: Chosen summaries.
    """

    seed: int
    places: list[int]
    deltas: list[int]

    def images(self, task: Any, actions: Tensor) -> list[Tensor]:
        """Return what the trials saw."""
        return [
            task.real_system(actions[place], seed=derive_seed(self.seed, "real", k))
            for k, place in enumerate(self.places)
        ]

    def once(self) -> Campaign:
        """Return a campaign with the first trial of each action alone."""
        first = [self.places.index(place) for place in dict.fromkeys(self.places)]
        return Campaign(
            self.seed,
            [self.places[k] for k in first],
            [self.deltas[k] for k in first],
        )


def campaigns(target: str, actions: Tensor, folder: Path) -> list[Campaign]:
    """Return ASBI's of a target, as their committed rows have them."""
    by_seed: dict[int, list[dict[str, str]]] = defaultdict(list)
    for row in read(folder / f"target_{target}_asbi.csv"):
        by_seed[int(row["seed"])].append(row)
    found = []
    for seed, rows in sorted(by_seed.items()):
        rows.sort(key=lambda row: int(row["round"]))
        chosen = torch.tensor(
            [[float(row[k]) for k in ("height", "position", "rate")] for row in rows]
        )
        places = torch.cdist(chosen, actions.float()).argmin(1).tolist()
        found.append(Campaign(seed, places, [int(row["delta"]) for row in rows]))
    return found


def belief_of(learned: ByAction, own: Campaign, images: list[Tensor]) -> GridBelief:
    """Return the belief that the benchmark's campaign has of images of its trials."""
    middles = GridBelief.middles().double().numpy()
    earlier: Earlier = defaultdict(list)
    total = np.zeros(len(middles))
    for place, delta, image in zip(own.places, own.deltas, images, strict=False):
        total += learned.log_likelihood(middles, image, delta, place, earlier)
    return GridBelief(torch.from_numpy(total * float(len(images)) ** -TEMPERED))


def box_around(beliefs: list[GridBelief]) -> Box:
    """Return a box of whole cells that holds nearly all of some beliefs."""
    mass = torch.stack([b.log_density.softmax(0) for b in beliefs]).mean(0)
    cube = mass.reshape(SIDE, SIDE, SIDE).numpy()
    low, high = np.zeros(3), np.ones(3)
    for k in range(3):
        others = tuple(j for j in range(3) if j != k)
        below = np.cumsum(cube.sum(others))
        low[k] = np.searchsorted(below, OUTSIDE) / SIDE
        high[k] = (np.searchsorted(below, 1 - OUTSIDE) + 1) / SIDE
    return Box(low, np.minimum(high, 1.0))


@dataclass(frozen=True)
class Pours:
    """Pours in a box at one action.

    Attributes:
        theta: Shape (n, 3).
        images: Shape (n, 22500).
    """

    theta: np.ndarray
    images: Tensor

    @cached_property
    def looks(self) -> tuple[np.ndarray, np.ndarray]:
        """Mesh coverage (n, 36) and thumbnails (n, 900)."""
        return looked_at(self.images)

    def learn(self, among: np.ndarray) -> BothSummaries:
        """Return the likelihood learned from some of them."""
        mesh, small = (look[among] for look in self.looks)
        mean, axes = components(small, NUM_COMPONENTS)
        summary = np.concatenate([np.sqrt(mesh), (small - mean) @ axes], 1)
        fitted = ImageLikelihood.fit(self.theta[among], summary, mesh.sum(1) == 0)
        return BothSummaries(fitted, mean, axes)


@dataclass(frozen=True)
class BothSummaries:
    """A likelihood of images by both summaries."""

    likelihood: ImageLikelihood
    mean: np.ndarray
    axes: np.ndarray

    def at(self, cells: np.ndarray, images: Tensor) -> np.ndarray:
        """Return log densities of images (n, 22500) at cells, shape (n, cells)."""
        mesh, small = looked_at(images)
        summary = np.concatenate([np.sqrt(mesh), (small - self.mean) @ self.axes], 1)
        seen = [
            observed(self.likelihood, s, not m.any())
            for s, m in zip(summary, mesh, strict=True)
        ]
        return self.likelihood.at_each(cells, seen)


def pour_around(
    bank: Path, target: str, box: Box, actions: Tensor, num: int, task: Any
) -> list[Pours]:
    """Return pours of the same parameters at each action, made where missing."""

    def drawn(part: str, number: int) -> Drawn:
        block, place = divmod(number, len(actions))
        seed = derive_seed(0, "around", part, block)
        with forked_generators(seed):
            unit = torch.rand(ROWS_A_FILE, 3)
        low, high = torch.from_numpy(box.low), torch.from_numpy(box.high)
        theta = (low + unit * (high - low)).float()
        action = actions[place].expand(ROWS_A_FILE, 3)
        return Drawn(theta, action, row_seeds(derive_seed(seed, place), ROWS_A_FILE))

    part = f"around_{target}"
    files = -(-num // ROWS_A_FILE) * len(actions)
    fill(bank, part, files * ROWS_A_FILE, (0, 1), task.pours, drawn)
    rows = read_bank(bank, part)
    return [at_action(rows, action, task) for action in actions]


def at_action(rows: Rows, action: Tensor, task: Any) -> Pours:
    """Return the stored pours at an action."""
    mine = (rows.action == action).all(1).numpy()
    images = images_of(rows.poses[mine], task.pours.particles)
    return Pours(rows.theta[mine].double().numpy(), images)


@dataclass(frozen=True)
class Reference:
    """What the campaigns of a target are judged by.

    Attributes:
        task: The task of this target.
        campaigns: Its campaigns.
        learned: What they learned their beliefs from.
        box: Box around their beliefs.
        pours: Pours in the box, by the place of the action.
    """

    task: Any
    campaigns: list[Campaign]
    learned: ByAction
    box: Box
    pours: dict[int, Pours]

    @staticmethod
    def of(
        target: str, learned: ByAction, bank: Path, arguments: ReferenceSettings
    ) -> Reference:
        """Return that of a target; pours that are missing are made."""
        task: Any = get_task("pouring", target=int(target))
        every = campaigns(target, learned.actions, arguments.results)
        beliefs = [
            belief_of(learned, own, own.images(task, learned.actions)) for own in every
        ]
        box = box_around(beliefs)
        print("box", box.low, box.high, f"volume {box.volume:.3f}", flush=True)
        places = sorted({place for own in every for place in own.places})
        actions = learned.actions[places]
        found = pour_around(bank, target, box, actions, arguments.rows, task)
        pours = dict(zip(places, found, strict=True))
        return Reference(task, every, learned, box, pours)


@dataclass(frozen=True)
class ReferenceSettings:
    """What is run.

    Args:
        bank: Folder of pours.
        target: Target of the paper; both by default.
        rows: Number of rows (of the reference).
        trials: Number of trials; all by default.
        results: Folder of the results.
        summary: Whether to run nothing, and print the table of the rows.
    """

    bank: Path | None = None
    target: Literal["1", "2"] | None = None
    rows: int = 200
    trials: int | None = None
    results: Path = RESULTS
    summary: bool = False


def run(
    arguments: ReferenceSettings,
    name: str,
    make: Callable[[Campaign, Reference], dict[str, object]],
    table: Callable[[list[dict[str, str]]], str],
) -> None:
    """Make the rows of campaigns that a file does not have yet, and print its table."""
    path = arguments.results / name
    if not arguments.summary:
        if arguments.bank is None:
            raise SystemExit("expected --bank FOLDER; got none; make one, see bank.py")
        learned = learn(arguments.bank, get_task("pouring"))
        for target in [arguments.target] if arguments.target else ["1", "2"]:
            known = Reference.of(target, learned, arguments.bank, arguments)
            by_seed = {own.seed: own for own in known.campaigns[: arguments.trials]}

            def made(_: str, seed: int, by: Any = by_seed, known: Any = known) -> Any:
                return make(by[seed], known)

            jobs = [(target, seed) for seed in by_seed]
            resumed(path, ["target", "seed"], jobs, made)
    print(table(read(path)))
