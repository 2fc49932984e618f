"""Simulations per CPU second beside a bare loop over the same steps.

    OMP_NUM_THREADS=1 python -m benchmarks box_collision.speed

Both run on the same rows, in turns: theta from the prior and speeds from the grid. The
bare loop sets the parameters and calls ``mj_step`` once a row, for the number of steps
that the simulator took; the difference is what Python adds. A third column runs all 400
steps. Writes ``speed.json`` beside itself.
"""

from __future__ import annotations

import json
import os
import time
from datetime import date
from pathlib import Path

import torch

from benchmarks.rows import in_turn, keep
from sbi_active.simulation import simulate
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.box_collision.scene import (  # pyright: ignore
    FRAMES,
    STEPS_PER_FRAME,
    Scene,
)

NUM_ROWS = 500
NUM_TURNS = 6


def main() -> None:
    task, scene = get_task("box_collision"), Scene()
    torch.manual_seed(0)
    theta = task.prior.sample((NUM_ROWS,))
    action = task.actions.sample((NUM_ROWS,), seed=0)
    rows = [*zip(theta.tolist(), action[:, 0].tolist(), strict=True)]
    steps = []
    for parameters, speed in rows:
        scene.run(parameters, speed)
        steps.append(scene.steps)
    full = [FRAMES * STEPS_PER_FRAME] * NUM_ROWS

    def bare(counts: list[int]) -> None:
        for (parameters, speed), count in zip(rows, counts, strict=True):
            scene.prepare(parameters, speed)
            scene.mujoco.mj_step(scene.model, scene.data, count)

    runs = {
        "simulate": lambda: simulate(task.simulator, theta, action, seed=0),
        "bare loop, same steps": lambda: bare(steps),
        "bare loop, all steps": lambda: bare(full),
    }
    seconds = in_turn(runs, NUM_TURNS, time.process_time)
    # The least disturbed turn of each: other programs only ever add time.
    best = {name: min(times) for name, times in seconds.items()}
    result = {
        "simulations per CPU second": {n: round(NUM_ROWS / s) for n, s in best.items()},
        "overhead": round(best["simulate"] / best["bare loop, same steps"] - 1, 3),
        "mean steps": sum(steps) / NUM_ROWS,
        "load average": round(os.getloadavg()[0], 1),
        "date": str(date.today()),
    }
    print(json.dumps(result, indent=2))
    path = Path(__file__).parent / "speed.json"
    keep(path, result)
