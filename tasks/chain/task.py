"""The chain of masses and springs as a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, LogNormal

from sbi_active.actions import DiscreteActions
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.chain.model import (
    MASS,
    NOISE_SD,
    SPREAD,
    STIFFNESS,
    mean,
    num_masses,
)
from sbi_active.tasks.chain.reference import ChainReference

__all__ = ["ChainTask"]

FREQUENCIES = (4.0, 10.0, 16.0, 22.0, 28.0, 34.0)  # rad/s; a chain has up to 40
NUM_CLAMPS = 5  # candidates at most


class ChainTask(Task):
    r"""Shake a chain of masses and springs and find them all.

    Model and units stand in :mod:`.model`. Under the prior the logarithms of all
    parameters are independent normals of deviation .3 around 400 N/m and 1 kg. The
    candidate actions are six frequencies at up to five places of the clamp.

    Args:
        parameters: From 4 to 20.
        theta_true: Of the real system, shape (parameters,), all positive; None is the
            same uneven chain for every number of parameters.

    Raises:
        ValueError: If the number is out of range or the truth is no such chain.

    Example:
        >>> task = ChainTask(parameters=4)
        >>> task.parameter_names
        ['stiffness_1', 'stiffness_2', 'mass_1', 'mass_2']
    """

    name = "chain"

    def __init__(
        self,
        *,
        parameters: int = 8,
        theta_true: Sequence[float] | Tensor | None = None,
    ) -> None:
        if parameters != int(parameters) or not 4 <= parameters <= 20:
            raise ValueError(
                f"expected from 4 to 20 parameters; got {parameters}; choose a whole "
                "number within"
            )
        self.parameters = parameters = int(parameters)
        springs = num_masses(parameters)
        masses = parameters - springs
        median = torch.tensor([STIFFNESS] * springs + [MASS] * masses)
        if theta_true is None:
            theta_true = median * torch.exp(
                0.3 * torch.sin(2.4 * torch.arange(parameters))
            )
        self.theta_true = torch.as_tensor(theta_true, dtype=torch.float32)
        positive = self.theta_true.isfinite() & (self.theta_true > 0)
        if self.theta_true.shape != (parameters,) or not bool(positive.all()):
            raise ValueError(
                f"expected theta_true of {parameters} positive numbers; got "
                f"{theta_true}; choose another truth"
            )
        spread = torch.full((parameters,), SPREAD)
        self.prior = Independent(LogNormal(median.log(), spread), 1)
        clamps = torch.linspace(2, springs, min(NUM_CLAMPS, springs - 1)).round()
        self.actions = DiscreteActions(
            torch.cartesian_prod(torch.tensor(FREQUENCIES), clamps),
            names=("frequency", "moving_masses"),
            units=("rad/s", ""),
        )
        names = [f"stiffness_{i + 1}" for i in range(springs)]
        names += [f"mass_{i + 1}" for i in range(masses)]
        self.simulator = SimulatorModel(
            mean, noise=GaussianNoise(NOISE_SD), parameter_names=names
        )

    def _options(self) -> dict[str, Any]:
        return {"parameters": self.parameters, "theta_true": self.theta_true}

    def reference(
        self, action: Tensor, x: Tensor, *, seed: int = 0, num_particles: int = 2_000
    ) -> Any:
        """Return the posterior given trials by long tempered SMC.

        It is a :class:`.ChainReference`, which knows no information gain.

        Args:
            action: Shape (t, 2).
            x: Shape (t, masses, 10).
            seed: Of the particles; two seeds tell the error.
            num_particles: Of each seed.
        """
        return ChainReference(
            self.prior, action, x, seed=seed, num_particles=num_particles
        )
