"""The servo pendulum as a task that replays recorded trials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.criticism import Effect, Trials
from sbi_active.criticism.data import Role
from sbi_active.simulation import NoiseModel, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.servo_pendulum.effects import make_effects
from sbi_active.tasks.servo_pendulum.model import (
    PARAMETER_NAMES,
    PRIOR_HIGH,
    PRIOR_LOW,
    angles,
)
from sbi_active.tasks.servo_pendulum.noise import servo_noise
from sbi_active.tasks.servo_pendulum.recordings import (
    RATE,
    Recordings,
    read_recordings,
)

__all__ = ["DATA", "ServoPendulumTask"]

#: Where the recorded trials are looked for, from the folder of the repository.
DATA = Path("../shared/data/servo_pendulum")
#: The motor of the data sheet, without friction.
NOMINAL = (0.46, 3.4, 0.0058, 0.005, 0.0)


class ServoPendulumTask(Task):
    r"""Find the motor of a servo from recorded swings of a pendulum.

    The parameters are torque constant, resistance, gain of the controller, armature and
    zero of the encoder, uniform around the data sheet; model and units stand in
    :mod:`.model`. An action is one of the recorded
    trials, (kp, number of the goal trajectory), and x the angle at 5 Hz. The real
    system replays what was recorded.

    Args:
        data: Folder of ``trials.csv`` and ``samples.csv``, or recordings.
        noise: Of the angle; None has autocorrelated noise of unknown size and
            correlation time.
        rate: Angles to compare a second.
        theta_true: Replays simulations at these parameters instead; None replays what
            was recorded, and has the motor of the data sheet as ``theta_true``.

    Raises:
        FileNotFoundError: If there are no recordings.
        ValueError: If they do not fit, or ``theta_true`` is not five numbers.
    """

    name = "servo_pendulum"

    def __init__(
        self,
        *,
        data: str | Path | Recordings = DATA,
        noise: NoiseModel | None = None,
        rate: float = RATE,
        theta_true: Sequence[float] | Tensor | None = None,
    ) -> None:
        self.recordings: Recordings = (
            data if isinstance(data, Recordings) else read_recordings(data, rate=rate)
        )
        self.rate = rate
        self.is_replay = theta_true is None
        truth = NOMINAL if theta_true is None else theta_true
        self.theta_true = torch.as_tensor(truth, dtype=torch.float32)
        if self.theta_true.shape != (len(PARAMETER_NAMES),):
            raise ValueError(
                f"expected theta_true of {len(PARAMETER_NAMES)} numbers, "
                f"{', '.join(PARAMETER_NAMES)}; got {theta_true}; give one each"
            )
        self.noise = servo_noise() if noise is None else noise
        self.prior = BoxUniform(torch.tensor(PRIOR_LOW), torch.tensor(PRIOR_HIGH))
        self.actions = DiscreteActions(
            torch.from_numpy(self.recordings.action).float(),
            names=["kp", "trajectory"],
            units=["", ""],
        )
        self.simulator = SimulatorModel(
            self.angles,
            noise=self.noise,
            parameter_names=PARAMETER_NAMES,
            sample_times=torch.from_numpy(self.recordings.times),
        )

    def angles(
        self,
        theta: Tensor,
        action: Tensor,
        *,
        coulomb: Any = 0.0,
        viscous: Any = 0.0,
        load: Any = 0.0,
        torque: Any = 0.0,
    ) -> Tensor:
        """Return the angles that the encoder reads in recorded trials, without noise.

        Args:
            theta: Shape (n, 5).
            action: Those of recorded trials, shape (n, 2).
            coulomb: Dry friction, N m; a number or one a row, as what follows.
            viscous: Viscous friction, N m s/rad.
            load: Dry friction as a share of the gravity load.
            torque: Dry friction as a share of the motor's torque.

        Returns:
            Shape (n, k), rad.

        Raises:
            ValueError: If an action was not recorded.
        """
        r = self.recordings
        x = angles(
            theta.detach().double().numpy(),
            r.kp,
            r.goal,
            r.enabled,
            r.start,
            self.find(action),
            coulomb=coulomb,
            viscous=viscous,
            load=load,
            torque=torque,
            every=r.every,
        )
        return torch.from_numpy(x).to(theta.dtype)

    def find(self, action: Tensor) -> np.ndarray:
        """Return the recorded trial of each action, (n, 2) -> (n,)."""
        recorded = torch.from_numpy(self.recordings.action)
        same = (action.double()[:, None] == recorded).all(-1)
        lost = torch.nonzero(~same.any(1))[:, 0]
        if len(lost):
            raise ValueError(
                "expected the action of a recorded trial, (kp, trajectory); got "
                f"{action[lost[0]].tolist()}; choose one of task.actions"
            )
        return same.int().argmax(1).numpy()

    def effects(self) -> list[Effect]:
        """Return the forms of friction that a servo may have."""
        return make_effects()

    def real_system(self, action: Tensor, *, seed: int | None = None) -> Tensor:
        """Return what was recorded, or a simulation at ``theta_true``, shape (k,)."""
        if not self.is_replay:
            return super().real_system(action, seed=seed)
        row = int(self.find(action.reshape(1, -1))[0])
        return torch.from_numpy(self.recordings.angle[row]).float()

    def trials(self, fit: Sequence[int], held_out: Sequence[int] = ()) -> Trials:
        """Return recorded trials.

        Args:
            fit: Rows of the recordings that may be fitted.
            held_out: Rows that are only scored.
        """
        rows = [*fit, *held_out]
        fitted: list[Role] = ["fit"] * len(fit)
        scored: list[Role] = ["held out"] * len(held_out)
        return Trials(
            self.recordings.action[rows],
            self.recordings.angle[rows],
            role=fitted + scored,
            index=rows,
            sample_times=self.recordings.times,
            channel_labels=["angle [rad]"],
        )

    def _options(self) -> dict[str, Any]:
        return {
            "data": self.recordings,
            "noise": self.noise,
            "rate": self.rate,
            "theta_true": None if self.is_replay else self.theta_true,
        }
