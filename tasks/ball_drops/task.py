"""The falling balls as a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.criticism import Effect
from sbi_active.tasks.ball_drops.effects import make_effects
from sbi_active.tasks.ball_drops.model import make_prior, make_simulator
from sbi_active.tasks.base import Task

__all__ = ["BallDropsTask"]

#: Area a mass from a bowling ball to a perforated one, m^2/kg.
AREAS = (0.016, 0.028, 0.033, 0.06, 0.09, 0.13, 0.15, 0.16)


class BallDropsTask(Task):
    """Drop a ball from a bridge of roughly known height, and film it.

    Gravity is known, and all that the simulator has; air and camera are in
    :meth:`effects`. The action is the choice of the ball.

    Args:
        theta_true: Error of the picture's scale, and its bend in m, shape (2,).

    Raises:
        ValueError: If ``theta_true`` is not two finite numbers.

    Example:
        >>> task = BallDropsTask()
        >>> task.simulator.mean(task.theta_true[None], task.actions.values[:1]).shape
        torch.Size([1, 60])
    """

    name = "ball_drops"

    def __init__(self, *, theta_true: Sequence[float] | Tensor = (0.0, 0.0)) -> None:
        self.theta_true = torch.as_tensor(theta_true, dtype=torch.float32)
        if self.theta_true.shape != (2,) or not bool(self.theta_true.isfinite().all()):
            raise ValueError(
                f"expected theta_true of two finite numbers; got {theta_true}; "
                "give, say, (0.0, 0.0)"
            )
        self.prior = make_prior()
        self.actions = DiscreteActions(
            torch.tensor(AREAS), names=["area_per_mass"], units=["m^2/kg"]
        )
        self.simulator = make_simulator()

    def effects(self) -> list[Effect]:
        """Return what a real fall may have besides, the release among it."""
        return make_effects()

    def _options(self) -> dict[str, Any]:
        return {"theta_true": self.theta_true}
