"""What the ball and hoop's parameters owe to which samples are fitted.

    python -m benchmarks.measured.hoop_samples --data DIR

Least squares of the motor with compression, and the prior of the offset beside it, to
one reading in 3 s from three first readings, in 1 s, in .5 s and to all: the error on
pieces that were left out, all of whose readings are scored, and on the held-out
records. The loop fits one reading in 3 s. Rows stand in ``results/hoop_samples.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.measured.hoop_least_squares import free_run, run_pieces
from sbi_active.criticism import Effect
from sbi_active.tasks.ball_and_hoop import (  # pyright: ignore
    DATA,
    make_effects,
    read_recordings,
    split,
)
from sbi_active.tasks.ball_and_hoop.model import OFFSET_SD  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.recordings import (  # pyright: ignore
    FITTED,
    LENGTH,
)
from sbi_active.tasks.records import Pieces, cut  # pyright: ignore

__all__ = ["left_out", "main", "refit", "table"]

Array = NDArray[Any]

RESULT = Path(__file__).parent / "results" / "hoop_samples.json"
#: First reading and every so many-th that are fitted, of 300 in a piece.
CHOICES = ((9, 30), (19, 30), (29, 30), (9, 10), (4, 5), (0, 1))
START = np.array([14.6, 0.79, 0.0, 0.5])  # drive, damping, offset, compression
SCALE = np.array([10.0, 1.0, OFFSET_SD, 0.5])
MISFIT = 0.4  # V, in which the prior of the offset is weighed against residuals


def refit(
    pieces: Pieces,
    effects: Sequence[Effect],
    kept: Array,
    samples: Array,
    start: Array = START,
) -> Array:
    """Return drive, damping, offset and compression, shape (4,).

    Args:
        pieces: All of them.
        effects: Compression.
        kept: Places of the pieces that are fitted.
        samples: Places of the readings that are.
        start: Of the search.
    """

    def residual(z: Array) -> Array:
        x = run_pieces(torch.from_numpy(z * SCALE)[None], pieces, effects)[0].numpy()
        error = (x - pieces.output)[kept][:, samples].ravel()
        return np.append(error / MISFIT, z[2])

    return least_squares(residual, start / SCALE, diff_step=1e-4, max_nfev=15).x * SCALE


def left_out(pieces: Pieces, effects: Sequence[Effect], samples: Array) -> float:
    """Return the root mean square error on pieces left out in turn, V."""
    every, square = np.arange(len(pieces)), []
    start = refit(pieces, effects, every, samples)
    for one in every:
        z = refit(pieces, effects, np.delete(every, one), samples, start)
        x = run_pieces(torch.from_numpy(z)[None], pieces, effects)[0, one].numpy()
        square.append(np.mean((x - pieces.output[one]) ** 2))
    return float(np.sqrt(np.mean(square)))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows in Markdown."""
    records = " / ".join(rows[0]["held"])
    lines = [
        "| readings of a piece | drive, 1/s | left-out pieces, V | held out: "
        f"{records} |",
        "|---|---|---|---|",
    ]
    for row in rows:
        held = " / ".join(f"{e:.3f}" for e in row["held"].values())
        lines.append(
            f"| {row['readings']}, from {0.1 * (row['first'] + 1):.1f} s | "
            f"{row['parameters'][0]:.2f} | {row['left_out']:.3f} | {held} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Fit what is missing from the results, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args(argv)
    if arguments.out.is_file():
        print(table(json.loads(arguments.out.read_text())))
        return 0
    try:
        records = read_recordings(arguments.data)
    except FileNotFoundError as error:
        print(f"{error}, as in --data DIR", file=sys.stderr)
        return 2
    pieces = cut(records["random_steps"].part(0, FITTED + 1), LENGTH)
    _, held = split(records)
    effects = [e for e in make_effects() if e.name == "compression"]
    rows, begin = [], time.process_time()
    for first, step in CHOICES:
        samples = np.arange(first, LENGTH, step)
        z = refit(pieces, effects, np.arange(len(pieces)), samples)
        rows.append(
            {
                "first": first,
                "readings": len(samples),
                "parameters": z.tolist(),
                "left_out": left_out(pieces, effects, samples),
                "held": free_run(torch.from_numpy(z)[None], held, effects),
                "cpu_seconds": time.process_time() - begin,
            }
        )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
