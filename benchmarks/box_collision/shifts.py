"""Shift that each effect makes of the cube's position, on a table without end.

    python -m benchmarks box_collision.shifts

Writes ``shifts.csv`` beside itself: a row an effect, strength and parameter set, with
the shift in mm of x and of y at 3, 5 and 7 m/s. It takes about five CPU seconds.
"""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import torch

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks.box_collision import make_effects  # pyright: ignore
from sbi_active.tasks.box_collision.model import positions  # pyright: ignore
from sbi_active.tasks.box_collision.scene import LocalScene  # pyright: ignore

SPEEDS = (3.0, 5.0, 7.0)  # m/s
PARAMETERS = {"target 1": 0.8, "middle": 0.5, "target 2": 0.2}
EDGE = 10.0  # m, beyond what a cube reaches
STRENGTHS = {
    "restitution": 0.7,
    "viscosity": 0.5,
    "air": 1.2,
    "tilt": 1.0,
    "speed gain": -0.05,
    "speed offset": 0.1,
    "aim": 0.01,
    "center of mass": 0.01,
    "pusher friction": 0.3,
    "force": 0.3,
    "camera bias": 0.01,
    "camera scale": 0.02,
    "time stamp": 0.05,
}


def main() -> None:
    model = SimulatorModel(
        positions, noise=GaussianNoise(0.005), setup=partial(LocalScene, edge=EDGE)
    )
    action = torch.tensor(SPEEDS)[:, None]
    rows = []
    for effect in make_effects():
        simulator = AugmentedSimulator(model, [effect])
        strength = STRENGTHS[effect.name]
        phi = {effect.name: torch.full((len(SPEEDS), 1), strength)}
        for name, value in PARAMETERS.items():
            theta = torch.full((len(SPEEDS), 3), value)
            moved = simulator.evaluate(theta, phi, action)
            shift = 1e3 * (moved - simulator.evaluate(theta, {}, action))
            row = {"effect": effect.name, "strength": strength, "units": effect.units}
            row |= {"theta": name}
            for axis, column in (("x", 0), ("y", 1)):
                for speed, mm in zip(SPEEDS, shift[:, column].tolist(), strict=True):
                    row[f"{axis} at {speed:g} m/s"] = f"{mm + 0.0:.1f}"
            rows.append(row)
            print(*row.values(), sep="  ")
    path = Path(__file__).parent / "shifts.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
