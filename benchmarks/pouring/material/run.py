"""The paper's Figure 16: what calibrated cubes share with a material, by round.

    python -m benchmarks.pouring.material.run --bank FOLDER              # campaigns
    python -m benchmarks.pouring.material.run --bank FOLDER --check 40   # poured anew
    python -m benchmarks.pouring.material.run --summary

The material is simulated, with particles that the model does not have, and no robot was
here: see ``get_task("pouring_real")``. Resumable: a trial that stands in the CSV is not
run again. One row a round, round 0 before the first trial.

InterVol is the mean over the belief of the volume that a pour of cubes and one of the
material share at 35 cm, 0 cm and 0.9 rad/s, here the mean over four pours of the
material. A Gaussian process over theta, on pours of the bank, gives its mean over the
chaos, which is then weighted by the belief; ``--check`` pours draws from the last
beliefs instead.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.learned import Earlier
from benchmarks.pouring.material.learned import (
    ByPlace,
    Overlap,
    PointBelief,
    compared_pours,
    kept,
)
from benchmarks.pouring.material.summary import checks_table, summarize
from benchmarks.pouring.run import TEMPERED
from benchmarks.rows import append, read, short
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import intersection_volume
from sbi_active.tasks.pouring.real import COMPARED_AT

RESULTS = Path(__file__).parents[1] / "results"
METHODS = ("asbi", "nsbi")
MATERIALS = ("beads", "gravel")
NUM_ROUNDS = 4
NUM_REAL = 4  # pours of the material that images are compared with
COLUMNS = [
    *["seed", "material", "method", "round", "height", "position", "rate", "delta"],
    *["in_view", "eig", "intervol", "effective", "cpu_design", "cpu_trial"],
]
CHECKED = ["seed", "material", "method", "num", "poured", "poured_se", "learned"]


@cache
def compared_images(material: str) -> Tensor:
    """Return pours of a material at the compared action, shape (4, 22500)."""
    task: Any = get_task("pouring_real", material=material)
    action = torch.tensor(COMPARED_AT)
    seeds = [derive_seed(0, "compared", material, k) for k in range(NUM_REAL)]
    return torch.stack([task.real_system(action, seed=seed) for seed in seeds])


def run_trial(
    task: Any, learned: ByPlace, overlap: Overlap, method: str, seed: int
) -> tuple[list[dict[str, object]], PointBelief]:
    """Return one row a round of one campaign, and its last belief."""
    belief, points = PointBelief.uniform(), PointBelief.points()
    first = {"seed": seed, "material": task.material, "method": method}
    rows = [{**first, "round": 0, "intervol": overlap.mean(belief)}]
    total = np.zeros(len(points))
    earlier: Earlier = defaultdict(list)
    for index in range(NUM_ROUNDS):
        start = time.process_time()
        gain = np.full((2, len(learned.actions)), np.nan)
        if method == "asbi":
            gain, _ = learned.gains(belief, earlier, derive_seed(seed, "gain", index))
            choice = int(gain.argmax())
        else:
            with forked_generators(derive_seed(seed, "action", index)):
                choice = int(torch.randint(gain.size, ()))
        delta, number = divmod(choice, gain.shape[1])
        action = learned.actions[number]
        designed = time.process_time()
        own_seed = derive_seed(seed, "real", task.material, index)
        image = task.real_system(action, seed=own_seed)
        total += learned.log_likelihood(points, image, delta, number, earlier)
        belief = PointBelief(total * (index + 1.0) ** -TEMPERED)
        rows.append(
            {
                **first,
                "round": index + 1,
                **dict(
                    zip(("height", "position", "rate"), action.tolist(), strict=True)
                ),
                "delta": delta,
                "in_view": float((image > 0).float().mean()),
                "eig": float(gain[delta, number]),
                "intervol": overlap.mean(belief),
                "effective": belief.effective,
                "cpu_design": designed - start,
                "cpu_trial": time.process_time() - designed,
            }
        )
    return rows, belief


def poured(belief: PointBelief, material: str, num: int, seed: int) -> np.ndarray:
    """Return the shared volume of fresh pours of draws from a belief, shape (num,)."""
    task: Any = get_task("pouring_real", material=material)
    theta = torch.from_numpy(belief.sample(num, seed)).float()
    action = torch.tensor(COMPARED_AT).expand(num, 3)
    seeds = torch.arange(num) + derive_seed(seed, "poured") % 2**40
    images = task.pours.images(theta, action, seeds=seeds)
    each = [intersection_volume(real, images) for real in compared_images(material)]
    return torch.stack(each).mean(0).double().numpy()


def run_missing(learned: ByPlace, arguments: argparse.Namespace) -> None:
    """Run the trials, or the checks, that are not in the files yet."""
    trials = arguments.results / "intervol.csv"
    checks = arguments.results / "intervol_poured.csv"
    path = checks if arguments.check else trials
    done = {(r["seed"], r["material"], r["method"]) for r in read(path)}
    for material in MATERIALS:
        task: Any = get_task("pouring_real", material=material)
        overlap = compared_pours(arguments.bank, compared_images(material))
        print(
            f"{material}: {overlap.explained:.2f} of the variance, {overlap.num} pours"
        )
        for seed in range(arguments.first, arguments.first + arguments.trials):
            for method in METHODS:
                if (str(seed), material, method) in done:
                    continue
                rows, belief = run_trial(task, learned, overlap, method, seed)
                if not arguments.check:
                    append(trials, COLUMNS, rows)
                    values = " ".join(f"{row['intervol']:.0f}" for row in rows)
                    print(material, method, seed, values, flush=True)
                    continue
                volume = poured(belief, material, arguments.check, seed)
                row = {
                    **{k: rows[0][k] for k in ("seed", "material", "method")},
                    "num": arguments.check,
                    "poured": float(volume.mean()),
                    "poured_se": float(volume.std(ddof=1) / np.sqrt(len(volume))),
                    "learned": rows[-1]["intervol"],
                }
                append(checks, CHECKED, [row])
                print(material, method, seed, short(row["poured"]), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="InterVol by round.")
    parser.add_argument("--bank", type=Path, help="folder of pours")
    parser.add_argument("--learned", type=Path, help="keeps what is learned of it")
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--first", type=int, default=2_300, help="seed of the first")
    parser.add_argument("--check", type=int, default=0, help="pours of each belief")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--summary", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if not arguments.summary:
        if arguments.bank is None:
            parser.error("expected --bank FOLDER; got none; make one, see bank.py")
        run_missing(kept(arguments.bank, arguments.learned), arguments)
    print(summarize(read(arguments.results / "intervol.csv")))
    print(checks_table(read(arguments.results / "intervol_poured.csv")))


if __name__ == "__main__":
    main()
