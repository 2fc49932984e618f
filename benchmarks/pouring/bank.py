"""Pours from the prior, kept as poses: what a first round may cost nothing of.

    python -m benchmarks pouring.bank FOLDER --rows 2300             # 27 actions
    python -m benchmarks pouring.bank FOLDER --part likely --rows 150
    python -m benchmarks pouring.bank FOLDER --report

A part ``likely`` pours at the actions that designs choose most alone, and is learned
from as ``prior`` is.

Resumable: files of 50 rows each, written whole. Row i of a part is a function of the
part's name and i alone, so that any number of processes may fill one folder, each with
its own share (``--share 0/2``). The folder stands outside the repository: a row of 100
cubes is 2.8 kB of poses.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import Pours

ROWS_A_FILE = 50
EFFECT = "effect_"  # before the names of effects in a file
PARTS = ("prior", "likely")
#: Actions that designed campaigns choose most.
LIKELY = ((20, 0, 0.5), (20, 0, 2), (20, -30, 5), (140, -30, 5), (140, 0, 2))


@dataclass(frozen=True)
class Rows:
    """Pours as they were stored.

    Attributes:
        theta: Shape (n, d).
        action: Shape (n, 3).
        poses: Shape (n, particles, 7), float32.
        cpu_seconds: Of all of them.
        effects: What they had besides, by keyword, each of shape (n,); most often none.
    """

    theta: Tensor
    action: Tensor
    poses: np.ndarray
    cpu_seconds: float
    effects: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.theta)


@dataclass(frozen=True)
class Drawn:
    """What a file of rows is poured with.

    Attributes:
        theta: Shape (n, d).
        action: Shape (n, 3).
        seeds: Shape (n,).
        effects: By keyword, each of shape (n,).
    """

    theta: Tensor
    action: Tensor
    seeds: Tensor
    effects: dict[str, np.ndarray] = field(default_factory=dict)


Draw = Callable[[str, int], Drawn]  # of a part and the number of a file


def draw(task: Any, part: str, number: int) -> Drawn:
    """Return parameters, actions and seeds of a file of rows."""
    seed = derive_seed(0, "pouring bank", part, number)
    with forked_generators(seed):
        theta = task.prior.sample(torch.Size([ROWS_A_FILE]))
    action = task.actions.sample((ROWS_A_FILE,), seed=seed)
    likely = torch.tensor(LIKELY, dtype=action.dtype)
    if part == "likely":
        action = likely.repeat(-(-ROWS_A_FILE // len(likely)), 1)[:ROWS_A_FILE]
    return Drawn(theta, action, row_seeds(seed, ROWS_A_FILE))


def fill(
    folder: Path, part: str, num: int, share: tuple[int, int], pours: Pours, drawn: Draw
) -> None:
    """Simulate the files that are missing."""
    folder = folder / part
    folder.mkdir(parents=True, exist_ok=True)
    mine, of = share
    for number in range(mine, -(-num // ROWS_A_FILE), of):
        path = folder / f"{number:05d}.npz"
        if path.exists():
            continue
        rows = drawn(part, number)
        start = time.process_time()
        poses = pours.poses(rows.theta, rows.action, rows.seeds, **rows.effects)
        spent = time.process_time() - start
        effects: dict[str, Any] = {EFFECT + k: v for k, v in rows.effects.items()}
        whole = path.with_suffix(f".{os.getpid()}.part")
        with whole.open("wb") as file:
            np.savez(
                file,
                theta=rows.theta.numpy(),
                action=rows.action.numpy(),
                poses=poses,
                cpu_seconds=spent,
                **effects,
            )
        whole.replace(path)


def read(folder: Path, part: str = "prior", *, most: int | None = None) -> Rows:
    """Return the rows of a part.

    Raises:
        FileNotFoundError: If there are none; the text says how to make some.
    """
    paths = sorted((folder / part).glob("*.npz"))
    if most is not None:
        paths = paths[: -(-most // ROWS_A_FILE)]
    if not paths:
        raise FileNotFoundError(
            f"expected pours in {folder / part}; got none; run python -m "
            f"benchmarks.pouring.bank {folder} --part {part}"
        )
    files = [np.load(path) for path in paths]
    return Rows(
        torch.from_numpy(np.concatenate([f["theta"] for f in files])),
        torch.from_numpy(np.concatenate([f["action"] for f in files])),
        np.concatenate([f["poses"] for f in files]),
        sum(float(f["cpu_seconds"]) for f in files),
        {
            name.removeprefix(EFFECT): np.concatenate([f[name] for f in files])
            for name in files[0].files
            if name.startswith(EFFECT)
        },
    )


def read_parts(folder: Path, parts: tuple[str, ...]) -> Rows:
    """Return the rows of those parts that are there, the first of which must be."""
    found = [read(folder, parts[0])]
    found += [read(folder, part) for part in parts[1:] if (folder / part).exists()]
    return Rows(
        torch.cat([rows.theta for rows in found]),
        torch.cat([rows.action for rows in found]),
        np.concatenate([rows.poses for rows in found]),
        sum(rows.cpu_seconds for rows in found),
        {},
    )


def report(folder: Path, part: str) -> str:
    """Return what a part holds and what it cost."""
    rows = read(folder, part)
    seconds = rows.cpu_seconds / len(rows)
    return f"{part}: {len(rows)} pours, {seconds:.3f} CPU s each at the mean"


@dataclass(frozen=True)
class Filling:
    """What is poured.

    Args:
        folder: Folder of the pours.
        part: Name of the part.
        rows: Number of rows.
        share: Share of the files that is poured, as in 0/2 and 1/2.
        report: Whether to simulate nothing, and print what the folder holds.
    """

    folder: Path
    part: Annotated[str, PARTS] = PARTS[0]
    rows: int = 6_000
    share: str = "0/1"
    report: bool = False


def run_filling(filling: Filling, pours: Pours, drawn: Draw) -> None:
    """Fill a part of a folder, and print what it holds.

    Args:
        filling: What is poured.
        pours: What pours rows.
        drawn: What draws them.
    """
    if not filling.report:
        mine, of = map(int, filling.share.split("/"))
        fill(filling.folder, filling.part, filling.rows, (mine, of), pours, drawn)
    print(report(filling.folder, filling.part))


def main(filling: Filling) -> None:
    """Pour from the prior, as poses."""
    task: Any = get_task("pouring")
    run_filling(filling, task.pours, partial(draw, task))
