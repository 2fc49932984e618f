"""Pours from the prior, kept as poses: what a first round may cost nothing of.

    python -m benchmarks pouring.bank FOLDER --rows 2300             # 27 actions
    python -m benchmarks pouring.bank FOLDER --part likely --rows 150
    python -m benchmarks pouring.bank FOLDER --rows 0      # what it holds

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.tasks import get_task

ROWS_A_FILE = 50
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
    """

    theta: Tensor
    action: Tensor
    poses: np.ndarray
    cpu_seconds: float

    def __len__(self) -> int:
        return len(self.theta)


#: Of a task, a part and the number of a file: parameters, actions and seeds.
Draw = Callable[[Any, str, int], tuple[Tensor, Tensor, Tensor]]


def draw(task: Any, part: str, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return parameters, actions and seeds of a file of rows."""
    seed = derive_seed(0, "pouring bank", part, number)
    with forked_generators(seed):
        theta = task.prior.sample(torch.Size([ROWS_A_FILE]))
    action = task.actions.sample((ROWS_A_FILE,), seed=seed)
    likely = torch.tensor(LIKELY, dtype=action.dtype)
    if part == "likely":
        action = likely.repeat(-(-ROWS_A_FILE // len(likely)), 1)[:ROWS_A_FILE]
    return theta, action, row_seeds(seed, ROWS_A_FILE)


def filling(
    name: str, draw: Draw, parts: Sequence[str], num: int
) -> Callable[..., None]:
    """Return the main of a bank.

    Args:
        name: Name of the task.
        draw: Function of the task, a part and the number of a file.
        parts: Names of the parts.
        num: Number of rows by default.
    """

    def main(
        folder: Path,
        *,
        part: str = parts[0],
        rows: int = num,
        share: str = "0/1",
    ) -> None:
        """Simulate the files that are missing, and print what the folder holds.

        Args:
            folder: Folder of the pours.
            part: Name of the part.
            rows: Number of rows.
            share: Share of the files that is poured, as in 0/2 and 1/2.
        """
        own, (mine, of) = folder / part, map(int, share.split("/"))
        own.mkdir(parents=True, exist_ok=True)
        for number in range(mine, -(-rows // ROWS_A_FILE), of):
            path = own / f"{number:05d}.npz"
            if not path.exists():
                _pour(path, get_task(name), *draw(get_task(name), part, number))
        known = read(folder, part)
        seconds = known.cpu_seconds / len(known)
        print(f"{part}: {len(known)} pours, {seconds:.3f} CPU s each at the mean")

    main.__annotations__["part"] = Annotated[str, parts]
    return main


def _pour(path: Path, task: Any, theta: Tensor, action: Tensor, seeds: Tensor) -> None:
    """Write a file of pours, whole."""
    start = time.process_time()
    poses = task.pours.poses(theta, action, seeds)
    spent = time.process_time() - start
    known: dict[str, Any] = {"theta": theta.numpy(), "action": action.numpy()}
    known |= {"poses": poses, "cpu_seconds": spent}
    whole = path.with_suffix(f".{os.getpid()}.part")
    with whole.open("wb") as file:
        np.savez(file, **known)
    whole.replace(path)


def read(folder: Path, part: str) -> Rows:
    """Return the rows of a part.

    Raises:
        FileNotFoundError: If there are none; the text says how to make some.
    """
    paths = sorted((folder / part).glob("*.npz"))
    if not paths:
        raise FileNotFoundError(
            f"expected pours in {folder / part}; got none; run python -m "
            f"benchmarks pouring.bank {folder} --part {part}"
        )
    files = [np.load(path) for path in paths]
    return Rows(
        torch.from_numpy(np.concatenate([f["theta"] for f in files])),
        torch.from_numpy(np.concatenate([f["action"] for f in files])),
        np.concatenate([f["poses"] for f in files]),
        sum(float(f["cpu_seconds"]) for f in files),
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
    )


main = filling("pouring", draw, PARTS, 6_000)
