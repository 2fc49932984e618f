"""The Go2's legs: what rigid legs with friction lack, from one record in the air.

    python -m benchmarks measured.go2 --data DIR

``DIR`` holds ``go2_in_air.xml`` and ``trajectory.csv``: 13 triangles of all joints,
from 3.0 to 0.6 s. Each leg is fitted to the first eight and judged on the five faster
ones, in one free run of the whole record from its first reading on. Stages of each
leg, which are added to ``results/go2.json`` unless they are there:

- ``FL``: the engineer's model, with armature, viscous damping, dry friction and a
  torque scale of each joint, against what ``mjcf_effects`` lists of the knee, its motor
  and its encoder, and the tilt of the base; of the other legs against four of these.
- ``FL, removed``: against these four without the effects that the first stage adopted.

What plain least squares of the same run found stands in ``go2.md``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.criticism.problem import counted
from benchmarks.measured.go2_leg import DATA, LEGS, Leg, read_leg, usual_parameters
from benchmarks.measured.record_stages import center, row_of
from benchmarks.rows import add, measured, stages
from benchmarks.table import shown
from sbi_active.criticism import Criticism
from sbi_active.criticism.results import ModelKey
from sbi_active.mujoco import mjcf_effects

Array = NDArray[np.float64]
RESULT = Path(__file__).parent / "results" / "go2.json"
PARTS = ("fitted", "held out")
#: Of a joint.
KINDS = ("friction loss by *", "static friction", "quadratic damping", "*stiffness")
KINDS += ("zero offset", "sensor bias", "sensor delay")
#: The same for the other legs, and with an effect removed: what was near on the first.
FEW_KINDS = ("friction loss by *", "static friction")


def judge(leg: Leg, removed: Sequence[str] = (), *, few: bool) -> dict[str, Any]:
    """Return the row of one verdict on the knee of the engineer's model.

    That has the torque scale of the motor already, "gain" by another name. What moves
    the body behind the joint by a second one is left out for what it costs.

    Args:
        leg: Leg that is fitted.
        removed: Names of effects that are not declared.
        few: Whether only what was near on the first leg is.
    """
    parameters = usual_parameters(leg)
    robot = leg.robot(parameters, leg.triangles())
    begin = time.process_time()
    joint, motor = leg.joints[-1], leg.motors[-1]
    kinds = FEW_KINDS if few else KINDS
    wanted = [*(f"{joint} {kind}" for kind in kinds), f"{motor} delay"]
    wanted += [] if few else [f"{motor} bias", "gravity tilt *"]
    effects = mjcf_effects(robot, include=wanted, exclude=removed)
    model, count = counted(robot.simulator)
    assert robot.trials is not None
    # The report's residuals, each trial predicted from those before, would take as
    # long as the verdict.
    tracing = Criticism(
        *(model, robot.prior, robot.trials),
        effects=effects,
        thin=False,  # readings are chosen by hand
        seed=0,
    ).trace()
    helps = [e for n in tracing.chosen for e in effects if e.name == n]
    values = center(tracing.evidences[str(ModelKey(tracing.chosen))])
    bare = center(tracing.evidences[str(ModelKey())])
    return row_of(tracing) | {
        "after": leg.errors(leg.free_run(parameters, helps, values)[0]),
        "before": leg.errors(leg.free_run(parameters, [], bare)[0]),
        "cpu_seconds": time.process_time() - begin,
        "trial_simulations": count(),
    }


def main(*, data: Path = DATA) -> None:
    """Run the stages that are missing from the results, and print the tables.

    Args:
        data: Folder of the measured set.
    """
    every, rows = [measured(read_leg, data, name) for name in LEGS], stages(RESULT)
    for leg in every:
        if leg.name not in rows:
            add(RESULT, rows, leg.name, judge(leg, few=leg.name != LEGS[0]))
        if (name := f"{leg.name}, removed") not in rows:
            helps = rows[leg.name]["helps"]
            add(RESULT, rows, name, judge(leg, helps, few=True))
    figures = ("verdict", "helps", "support", "before", "after", "parameters")
    print(shown(RESULT, *(f"*, {name}*" for name in figures), "*cpu_seconds"))
