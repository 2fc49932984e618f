"""The driven oscillator as a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.oscillator.model import (
    ACTION_NAMES,
    ACTION_UNITS,
    ACTIONS,
    NOISE_SD,
    PARAMETER_NAMES,
    PRIOR_HIGH,
    PRIOR_LOW,
    mean,
)
from sbi_active.tasks.oscillator.reference import OscillatorReference

__all__ = ["OscillatorTask"]


class OscillatorTask(Task):
    r"""Shake an oscillator and find its frequency, damping, gain and delay.

    Model and units stand in :mod:`.model`. The candidate
    actions are 35 pairs of amplitude and frequency.

    Args:
        theta_true: Parameters of the real system, within the prior's box.

    Raises:
        ValueError: If ``theta_true`` leaves the box.

    Example:
        >>> task = OscillatorTask()
        >>> task.simulator.mean(task.theta_true[None], torch.tensor([[1.0, 5.0]])).shape
        torch.Size([1, 6])
    """

    name = "oscillator"

    def __init__(
        self, *, theta_true: Sequence[float] | Tensor = (3.7, 0.15, 1.1, 0.12)
    ) -> None:
        self.theta_true = torch.as_tensor(theta_true, dtype=torch.float32)
        self.prior = BoxUniform(PRIOR_LOW, PRIOR_HIGH)
        inside = self.theta_true.shape == PRIOR_LOW.shape and bool(
            ((self.theta_true >= PRIOR_LOW) & (self.theta_true <= PRIOR_HIGH)).all()
        )
        if not inside:
            raise ValueError(
                "expected theta_true of four numbers between "
                f"{PRIOR_LOW.tolist()} and {PRIOR_HIGH.tolist()}; got {theta_true}; "
                "choose another truth"
            )
        self.actions = DiscreteActions(ACTIONS, names=ACTION_NAMES, units=ACTION_UNITS)
        self.simulator = SimulatorModel(
            mean, noise=GaussianNoise(NOISE_SD), parameter_names=PARAMETER_NAMES
        )

    def _options(self) -> dict[str, Any]:
        return {"theta_true": self.theta_true}

    def reference(self, action: Tensor, x: Tensor) -> OscillatorReference:
        """Return the posterior given trials by importance sampling, nearly exact.

        Args:
            action: Shape (t, 2).
            x: Shape (t, 6).
        """
        return OscillatorReference(action, x)
