"""Simulations a CPU second of robots from their MJCF, beside a bare loop.

    python -m benchmarks robots.speed [--go2 ../shared/data/go2_in_air/go2_in_air.xml]

Of each model a second of simulated time from a start that differs by row, with another
mass or damping in each row, and all readings of all sensors. Ways take turns in one
process on one thread:

- ours: ``simulator.mean`` of all rows;
- bare: a Python loop over ``mj_step`` that writes the parameter into the one model.

Writes speed.json beside this file: rows, steps, and rows a CPU second (median, lowest
and highest of the repeats).
"""

from __future__ import annotations

import json
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.robots.models import ARM, CART_POLE, PENDULUM, SPRING_MASS
from benchmarks.rows import in_turn, keep
from sbi_active import BoxActions
from sbi_active.mujoco import from_mjcf
from sbi_active.mujoco.models.spec import mujoco

RESULT = Path(__file__).with_suffix(".json")
SECONDS = 1.0
NUM_ROWS, REPEATS = 64, 5
MODELS = {
    "pendulum": (PENDULUM, "hinge", 0.0, 0.1),
    "spring-mass": (SPRING_MASS, "slide", 0.0, 1.0),
    "cart-pole": (CART_POLE, "hinge", 0.0, 0.01),
    "two-link arm": (ARM, "elbow", 0.05, 0.2),
}


def ways(xml: Any, joint: str, low: float, high: float, num: int) -> dict[str, Any]:
    """Return the ways of simulating rows, and how many steps each has."""
    spec = mujoco.MjSpec.from_string(xml) if isinstance(xml, str) else xml
    model = spec.compile()
    joints = [model.joint(i).name for i in range(model.njnt)]
    step = model.opt.timestep
    steps = round(SECONDS / step) + 1
    robot = from_mjcf(
        spec,
        {f"{joint}.damping": (low, high)},
        sensors=None if model.nsensor else joints,
        actions=BoxActions([-0.5], [0.5], names=[joint]),
        times=step * np.arange(steps),
        noise=0.01,
    )
    simulator = robot.simulator
    base = simulator.fn.model
    theta = torch.linspace(low, high, num, dtype=torch.float64)[:, None]
    action = torch.linspace(-0.5, 0.5, num, dtype=torch.float64)[:, None]
    dof = int(base.joint(joint).dofadr[0])
    place = int(base.joint(joint).qposadr[0])
    one, data = base.__copy__(), mujoco.MjData(base)

    def bare() -> np.ndarray:
        found = np.empty((num, steps, base.nsensordata))
        for i in range(num):
            one.dof_damping[dof] = float(theta[i])
            mujoco.mj_resetData(one, data)
            data.qpos[place] = float(action[i])
            for k in range(steps):
                mujoco.mj_step(one, data)
                found[i, k] = data.sensordata
        return found

    run = {"ours": lambda: simulator.mean(theta, action), "bare": bare}
    x = run["ours"]().reshape(num, steps, -1).numpy()
    difference = float(np.abs(x - bare()).max())
    return {"run": run, "steps": steps, "difference": difference}


def measured(models: dict[str, Any]) -> dict[str, Any]:
    """Return rows a CPU second, by model and way."""
    result = {}
    for name, given in models.items():
        xml, joint, low, high = given
        own = ways(xml, joint, low, high, NUM_ROWS)
        spent = in_turn(own["run"], REPEATS, time.process_time)
        result[name] = {
            "steps": own["steps"],
            "largest_difference_from_bare": own["difference"],
            "rows_per_cpu_second": {
                way: {
                    "median": round(NUM_ROWS / float(np.median(each)), 1),
                    "lowest": round(NUM_ROWS / max(each), 1),
                    "highest": round(NUM_ROWS / min(each), 1),
                }
                for way, each in spent.items()
            },
        }
        print(name, json.dumps(result[name]["rows_per_cpu_second"]))
    return result


def main(*, go2: Path | None = None) -> None:
    """Run from a shell.

    Args:
        go2: File of the Go2's model.
    """
    models: dict[str, Any] = dict(MODELS)
    if go2 is not None:
        spec = mujoco.MjSpec.from_file(str(go2))
        models["quadruped, 12 joints"] = (spec, "FL_calf_joint", 0.0, 1.0)
    record = {
        "date": date.today().isoformat(),
        "mujoco": mujoco.__version__,
        "rows": NUM_ROWS,
        "repeats": REPEATS,
        "models": measured(models),
    }
    keep(RESULT, record)
