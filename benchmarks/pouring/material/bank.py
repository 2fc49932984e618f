"""Pours of the eight-parameter model, behind campaigns on a material.

    python -m benchmarks pouring.material.bank FOLDER --part prior --rows 300
    python -m benchmarks pouring.material.bank FOLDER --part compared --rows 150
    python -m benchmarks pouring.material.bank FOLDER --rows 0

Rows of ``prior`` are shared out by where the bucket stands: half of them at p = 0, two
fifths at -30 cm, a tenth at 30 cm, from where next to nothing comes into view; a
quarter at the slow rate, which costs twice as much. ``compared`` pours where the paper
compares images. Files and their resumption are those of ``benchmarks.pouring.bank``.
One bank serves beads and gravel: where all particles have one density it cancels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import ROWS_A_FILE, filling
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.tasks.pouring.real import COMPARED_AT, HEIGHTS, RATES

PARTS = ("prior", "compared")
PLACES, PLACE_SHARES = (-30.0, 0.0, 30.0), (0.4, 0.5, 0.1)
RATE_SHARES = (0.25, 0.375, 0.375)


def draw(task: Any, part: str, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return parameters, actions and seeds of a file of rows."""
    seed = derive_seed(0, "material bank", part, number)
    with forked_generators(seed):
        theta = task.prior.sample(torch.Size([ROWS_A_FILE]))
    rng = np.random.default_rng(seed)
    action = np.stack(
        [
            rng.choice(HEIGHTS, ROWS_A_FILE),
            rng.choice(PLACES, ROWS_A_FILE, p=PLACE_SHARES),
            rng.choice(RATES, ROWS_A_FILE, p=RATE_SHARES),
        ],
        1,
    )
    if part == "compared":
        action = np.tile(COMPARED_AT, (ROWS_A_FILE, 1))
    return theta, torch.tensor(action).float(), row_seeds(seed, ROWS_A_FILE)


main = filling("pouring_real", draw, PARTS, 300)
