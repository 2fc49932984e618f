"""The paper's Figure 16: what calibrated cubes share with a material, by round.

    python -m benchmarks pouring.material --bank FOLDER              # campaigns
    python -m benchmarks pouring.material --summary

The material is simulated, with particles that the model does not have, and no robot was
here: see ``get_task("pouring_real")``. Resumable: a trial that stands in the CSV is not
run again. One row a round, round 0 before the first trial.

InterVol is the mean over the belief of the volume that a pour of cubes and one of the
material share at 35 cm, 0 cm and 0.9 rad/s, here the mean over four pours of the
material. A Gaussian process over theta, on pours of the bank, gives its mean over the
chaos, which is then weighted by the belief.

Figure 16 of the paper, from the rows of a run.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.campaign import rounds
from benchmarks.pouring.learned import ByAction
from benchmarks.pouring.material.learned import (
    Overlap,
    PointBelief,
    compared_pours,
    learn,
)
from benchmarks.rounds import Rows
from benchmarks.rows import frame, published, read, resumed
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring.real import COMPARED_AT

#: Section 6, medians of ASBI, mm summed over pixels of 1,000 particles, and how far
#: NSBI is below it at the last round.
PUBLISHED = published("pouring a material")


def summarize(rows: Rows) -> str:
    """Return InterVol by round, the paper's beside it."""
    if not rows:
        return "no trials yet"
    table, lines = [], []
    by_cell = dict(iter(frame(rows).groupby(["material", "method"])))
    for material, (paper, behind) in PUBLISHED.items():
        last = {}
        for method in METHODS:
            cell = by_cell.get((material, method))
            if cell is None:
                continue
            is_last = cell["round"] == cell["round"].max()
            final = last[method] = np.asarray(cell["intervol"][is_last])
            medians = [*cell.groupby("round")["intervol"].median()]
            table.append(
                [
                    f"{material}, {method.upper()}",
                    str(len(final)),
                    " / ".join(f"{v:.0f}" for v in medians),
                    f"{final.min():.0f} .. {final.max():.0f}",
                    f"{medians[-1] / medians[0] - 1:+.0%}",
                    f"{(cell['position'].dropna() == 0).mean():.2f}",
                    paper if method == "asbi" else f"{behind} below",
                ]
            )
        if len(last) == 2:
            ours, theirs = np.median(last["asbi"]), np.median(last["nsbi"])
            pairs = (last["asbi"] > last["nsbi"]).sum()
            lines.append(
                f"{material}: ASBI's median is {ours / theirs:.2f} of NSBI's at the "
                f"last round, and above it in {pairs} of {len(last['asbi'])} pairs"
            )
    header = ["", "trials", "median InterVol by round, mm", "last: min .. max"]
    header += ["last to first", "share at p = 0", "paper (1,000, a robot)"]
    return "\n\n".join([Table(header, table).text(), *lines])


RESULT = Path(__file__).parents[1] / "results/intervol.csv"
METHODS = ("asbi", "nsbi")
MATERIALS = ("beads", "gravel")
NUM_ROUNDS = 4
NUM_REAL = 4  # pours of the material that images are compared with


@cache
def compared_images(material: str) -> Tensor:
    """Return pours of a material at the compared action, shape (4, 22500)."""
    task: Any = get_task("pouring_real", material=material)
    action = torch.tensor(COMPARED_AT)
    seeds = [derive_seed(0, "compared", material, k) for k in range(NUM_REAL)]
    return torch.stack([task.real_system(action, seed=seed) for seed in seeds])


def run_trial(
    task: Any, learned: ByAction, overlap: Overlap, seed: int, _: str, method: str
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    belief = PointBelief.uniform()
    rows: list[dict[str, object]] = [{"round": 0, "intervol": overlap.mean(belief)}]
    for found in rounds(
        *(task, learned, PointBelief, PointBelief.points()),
        num=NUM_ROUNDS,
        seed=seed,
        is_active=method == "asbi",
        name=(task.material,),
    ):
        belief = found.belief
        rows.append(found.row() | {"intervol": overlap.mean(belief)})
    return rows


def run_missing(bank: Path, seeds: range) -> None:
    """Run the trials that are not in the file yet."""
    learned = learn(bank)
    for material in MATERIALS:
        task: Any = get_task("pouring_real", material=material)
        overlap = compared_pours(bank, compared_images(material))
        print(
            f"{material}: {overlap.explained:.2f} of the variance, {overlap.num} pours"
        )
        trial = partial(run_trial, task, learned, overlap)
        jobs = [(seed, material, m) for seed in seeds for m in METHODS]
        resumed(RESULT, ("seed", "material", "method"), jobs, trial)


def main(
    *,
    bank: Path | None = None,
    seeds: tuple[int, int] = (2_300, 2_303),
    summary: bool = False,
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        bank: Folder of pours.
        seeds: First, and one past the last.
        summary: Whether to run nothing, and print the table of the rows.
    """
    if not summary:
        if bank is None:
            raise SystemExit("expected --bank FOLDER; got none; make one, see bank.py")
        run_missing(bank, range(*seeds))
    print(summarize(read(RESULT)))
