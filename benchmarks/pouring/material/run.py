"""The paper's Figure 16: what calibrated cubes share with a material, by round.

    python -m benchmarks pouring.material --bank FOLDER              # campaigns
    python -m benchmarks pouring.material --bank FOLDER --check 40   # poured anew
    python -m benchmarks pouring.material --summary

The material is simulated, with particles that the model does not have, and no robot was
here: see ``get_task("pouring_real")``. Resumable: a trial that stands in the CSV is not
run again. One row a round, round 0 before the first trial.

InterVol is the mean over the belief of the volume that a pour of cubes and one of the
material share at 35 cm, 0 cm and 0.9 rad/s, here the mean over four pours of the
material. A Gaussian process over theta, on pours of the bank, gives its mean over the
chaos, which is then weighted by the belief; ``--check`` pours draws from the last
beliefs instead.

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
from benchmarks.rows import column, frame, read, resumed
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import intersection_volume
from sbi_active.tasks.pouring.real import COMPARED_AT

#: Section 6, medians of ASBI, mm summed over pixels of 1,000 particles, and how far
#: NSBI is below it at the last round.
PUBLISHED = {
    "beads": ("0.95e4 .. 1.20e4", "24 %"),
    "gravel": ("1.32e4 .. 2.13e4", "13 %"),
}


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


def checks_table(rows: Rows) -> str:
    """Return InterVol of fresh pours of the last beliefs beside the learned one."""
    if not rows:
        return ""
    table = [
        [
            f"{r['material']}, {r['method'].upper()}, {r['seed']}",
            r["num"],
            f"{float(r['poured']):.0f} +- {float(r['poured_se']):.0f}",
            f"{float(r['learned']):.0f}",
        ]
        for r in rows
    ]
    gap = column(rows, "learned") - column(rows, "poured")
    error = column(rows, "poured_se")
    text = Table(["last belief of", "pours", "poured anew", "learned"], table).text()
    spread, noise = np.sqrt((gap**2).mean()), np.sqrt((error**2).mean())
    return (
        f"\n{text}\nlearned less poured: {gap.mean():+.0f} mm at the mean, root mean "
        f"square {spread:.0f}, of an error of {noise:.0f}"
    )


RESULTS, FILE = Path(__file__).parents[1] / "results", "intervol.csv"
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
    task: Any, learned: ByAction, overlap: Overlap, method: str, seed: int
) -> tuple[list[dict[str, object]], PointBelief]:
    """Return one row a round of one campaign, and its last belief."""
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
        more = {"intervol": overlap.mean(belief), "effective": belief.effective}
        rows.append(found.row() | more)
    return rows, belief


def poured(belief: PointBelief, material: str, num: int, seed: int) -> np.ndarray:
    """Return the shared volume of fresh pours of draws from a belief, shape (num,)."""
    task: Any = get_task("pouring_real", material=material)
    theta = torch.from_numpy(belief.draws(num, seed)).float()
    action = torch.tensor(COMPARED_AT).expand(num, 3)
    seeds = torch.arange(num) + derive_seed(seed, "poured") % 2**40
    images = task.pours.images(theta, action, seeds=seeds)
    each = [intersection_volume(real, images) for real in compared_images(material)]
    return torch.stack(each).mean(0).double().numpy()


def run_missing(bank: Path, seeds: range, num_poured: int) -> None:
    """Run the trials, or the checks, that are not in the files yet."""
    learned = learn(bank)
    for material in MATERIALS:
        task: Any = get_task("pouring_real", material=material)
        overlap = compared_pours(bank, compared_images(material))
        print(
            f"{material}: {overlap.explained:.2f} of the variance, {overlap.num} pours"
        )
        trial = partial(run_trial, task, learned, overlap)

        def rows(
            seed: int, _: str, method: str, trial: Any = trial
        ) -> list[dict[str, object]]:
            return trial(method, seed)[0]

        def check(
            seed: int, material: str, method: str, trial: Any = trial
        ) -> dict[str, object]:
            made, belief = trial(method, seed)
            volume = poured(belief, material, num_poured, seed)
            error = volume.std(ddof=1) / np.sqrt(len(volume))
            told = {"num": len(volume), "poured": volume.mean(), "poured_se": error}
            return told | {"learned": made[-1]["intervol"]}

        jobs = [(seed, material, m) for seed in seeds for m in METHODS]
        path, make = ("intervol_poured.csv", check) if num_poured else (FILE, rows)
        resumed(RESULTS / path, ("seed", "material", "method"), jobs, make)


def main(
    *,
    bank: Path | None = None,
    seeds: tuple[int, int] = (2_300, 2_303),
    check: int = 0,
    summary: bool = False,
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        bank: Folder of pours.
        seeds: First, and one past the last.
        check: Number of pours of each belief; none by default.
        summary: Whether to run nothing, and print the table of the rows.
    """
    if not summary:
        if bank is None:
            raise SystemExit("expected --bank FOLDER; got none; make one, see bank.py")
        run_missing(bank, range(*seeds), check)
    print(summarize(read(RESULTS / FILE)))
    print(checks_table(read(RESULTS / "intervol_poured.csv")))
