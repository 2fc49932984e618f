"""Measured sets, as problems of the closed loop.

Their files stand beside the project, see each task's ``DATA``; where they are absent, a
case of the record says so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.measured import ball_and_hoop, ball_drops, cascaded_tanks
from sbi_active.tasks import ball_and_hoop as hoop_task  # pyright: ignore
from sbi_active.tasks import cascaded_tanks as tanks_task  # pyright: ignore
from sbi_active.tasks.ball_drops import (  # pyright: ignore
    make_effects,
    make_prior,
    make_simulator,
    read_drops,
    trials_of,
)
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore


def servo(*, motor_off: int) -> SimpleNamespace:
    """Return the servo, with so many trials whose motor is off."""
    task = ServoPendulumTask()
    off = np.flatnonzero(task.recordings.motor_off).tolist()
    rows = [i for i in range(len(task.recordings)) if i not in off]
    return SimpleNamespace(
        model=task.simulator,
        prior=task.prior,
        trials=task.trials([*rows, *off[:motor_off]], []),
        effects=task.effects(),
    )


def drops(ball: str) -> SimpleNamespace:
    """Return the drops of a ball."""
    every = read_drops(ball_drops.DATA)
    return SimpleNamespace(
        model=make_simulator(),
        prior=make_prior(),
        trials=trials_of([drop for drop in every if drop.ball == ball]),
        effects=make_effects(),
    )


def bench(task: Any, make: Callable[..., Any]) -> Any:
    """Return a machine with records."""
    return make(task.read_recordings(task.DATA))


MEASURED: dict[str, Callable[[], Any]] = {
    "servo powered": partial(servo, motor_off=0),
    "servo motor off": partial(servo, motor_off=1),
    "hoop": partial(bench, hoop_task, ball_and_hoop.make_bench),
    "tanks": partial(bench, tanks_task, cascaded_tanks.make_bench),
    **{
        f"drops {ball}": partial(drops, ball)
        for ball in ("baseball", "blue_basketball", "golf_ball", "tennis_ball")
    },
}
