"""How far repeats of an action are to be trusted: the share c of ``likelihood``.

    python -m benchmarks pouring.bank FOLDER --part repeats --rows 100
    python -m benchmarks pouring.repeats FOLDER

Each theta of the part "repeats" was poured five times at one action. The table says,
by c and by the number of repeats, the mean log density of theta and how often it is
within regions of highest density. It tunes, and judges nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pouring.bank import AT_A_THETA
from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.learned import ByAction, Learned, kept
from benchmarks.pouring.likelihood import doubted
from benchmarks.pouring.power import grid
from sbi_active.display.table import Table
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of

__all__ = ["after_each", "repeats_table"]

SHARES = (0.0, 0.1, 0.3, 0.5, 0.7)
SIDE = 16  # cells along each parameter
SHOWN = (1, 2, 3, 5)  # repeats


def groups(bank: Path, learned: ByAction) -> Iterator[tuple[Learned, np.ndarray, list]]:
    """Yield a likelihood, theta (3,) and what it takes of five images."""
    task: Any = get_task("pouring")
    rows = read_bank(bank, "repeats")
    for start in range(0, len(rows), AT_A_THETA):
        mine = slice(start, start + AT_A_THETA)
        images = images_of(rows.poses[mine], task.pours.particles)
        near = (learned.actions == rows.action[start]).all(1)
        place = int(near.nonzero()[0])
        for delta in (0, 1):
            own = learned.learned[delta][place]
            theta = rows.theta[start].double().numpy()
            yield own, theta, [own.seen(image, delta) for image in images]


def after_each(own: Learned, outcomes: list[Any], theta: np.ndarray) -> np.ndarray:
    """Return w log p of outcomes, one after the other, by c, (c, outcomes, n)."""
    likelihood = own.likelihood
    parts = likelihood.parts(theta) if likelihood.statistic is not None else None
    found = np.zeros((len(SHARES), len(outcomes), len(theta)))
    for row, shared in zip(found, SHARES, strict=True):
        some, earlier = replace(likelihood, shared=shared), []
        for k, seen in enumerate(outcomes):
            row[k] = some.at_each(theta, [seen], earlier, parts)[0]
            if seen is not None and len(seen):
                earlier.append(seen)
    return doubted(found, likelihood.power)


def repeats_table(bank: Path, learned: ByAction) -> str:
    """Return how theta is told after each repeat, by c."""
    cells = grid(SIDE)
    told, mass = [], []
    for own, theta, outcomes in groups(bank, learned):
        log_p = np.cumsum(after_each(own, outcomes, cells), 1)
        log_p = log_p - np.logaddexp.reduce(log_p, axis=2)[..., None]
        place = np.minimum((theta * SIDE).astype(int), SIDE - 1)
        truth = log_p[..., np.ravel_multi_index(tuple(place), (SIDE,) * 3)]
        told.append(truth + np.log(len(cells)))
        mass.append(np.where(log_p > truth[..., None], np.exp(log_p), 0).sum(2))
    log_density, denser = np.stack(told), np.stack(mass)
    table = []
    for k, shared in enumerate(SHARES):
        entry = [f"{shared:g}"]
        for num in SHOWN:
            some = denser[:, k, num - 1]
            half, most = (some <= 0.5).mean(), (some <= 0.9).mean()
            mean = log_density[:, k, num - 1].mean()
            entry.append(f"{mean:.2f}, {half:.2f}, {most:.2f}")
        table.append(entry)
    return Table(["c", *[f"{num} pours" for num in SHOWN]], table).text()


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        bank: Folder of pours.
        learned: File that keeps what is learned of the pours.
    """

    bank: Path
    learned: Path | None = None


def main(arguments: Settings) -> None:
    """Run what is asked for and is not there yet, and print the table."""
    learned = kept(arguments.bank, arguments.learned)
    print("mean log p(theta), share within 50 % region, within 90 %")
    print(repeats_table(arguments.bank, learned))
