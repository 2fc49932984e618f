"""Tasks: a simulator, a prior, actions and a real system, ready to use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sbi_active.tasks.ball_drops import BallDropsTask
from sbi_active.tasks.base import Task
from sbi_active.tasks.box_collision import BoxCollisionTask
from sbi_active.tasks.chain import ChainTask
from sbi_active.tasks.location_finding import LocationFindingTask
from sbi_active.tasks.numerical import NumericalTask
from sbi_active.tasks.oscillator import OscillatorTask
from sbi_active.tasks.pouring import PouringRealTask, PouringTask
from sbi_active.tasks.servo_pendulum import ServoPendulumTask

__all__ = ["TASKS", "Task", "get_task"]

TASKS: dict[str, Callable[..., Task]] = {
    "numerical": NumericalTask,
    "oscillator": OscillatorTask,
    "box_collision": BoxCollisionTask,
    "pouring": PouringTask,
    "pouring_real": PouringRealTask,
    "servo_pendulum": ServoPendulumTask,
    "ball_drops": BallDropsTask,
    "location_finding": LocationFindingTask,
    "chain": ChainTask,
}


def get_task(name: str, **options: Any) -> Task:
    """Return a task by name.

    Args:
        name: One of ``TASKS``.
        options: Of the task, for example ``variant="sinh"``.

    Raises:
        ValueError: If there is no such task; the text lists the valid names.

    Example:
        >>> get_task("numerical").parameter_names
        ['theta_1', 'theta_2']
    """
    if name not in TASKS:
        raise ValueError(
            f"expected a task among {', '.join(map(repr, TASKS))}; got {name!r}; "
            "choose one of these"
        )
    return TASKS[name](**options)
