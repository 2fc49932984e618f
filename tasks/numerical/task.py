"""The numerical model of Kim & Matsubara (2025), section 5.2."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.numerical.exact import ExactPosterior

__all__ = ["NumericalTask", "Variant"]

Variant = Literal["linear", "sinh", "square"]

BOUND = 5.0


class NumericalTask(Task):
    r"""Two parameters, one action, one number.

    .. math::
        x = g(\theta_1) \exp(3 - \xi) + \theta_2 \xi + \epsilon, \quad
        \epsilon \sim N(0, 1), \quad \theta \sim U[-5, 5]^2, \quad
        \xi \in \{-5, -4.5, \ldots, 5\}

    with :math:`g(t) = t` in the paper. The variants keep a method honest that only
    works where x is linear in the parameters: "sinh", :math:`5 \sinh(t / 2.5) / \sinh
    2`; and "square", :math:`t^2 / 2.5 - 5`, whose posterior has two modes.

    Args:
        variant: Of g.
        theta_true: Parameters of the real system, within the box.

    Raises:
        ValueError: If the variant is unknown or ``theta_true`` leaves the box.

    References:
        Kim & Matsubara, Applied Intelligence 2025, section 5.2 and Table 1.

    Example:
        >>> task = NumericalTask()
        >>> task.simulator.mean(task.theta_true[None], torch.tensor([[3.0]]))
        tensor([[0.]])
    """

    name = "numerical"

    def __init__(
        self,
        *,
        variant: Variant = "linear",
        theta_true: Sequence[float] | Tensor = (-3.0, 1.0),
    ) -> None:
        if variant not in TRANSFORMS:
            raise ValueError(
                f"expected variant among {', '.join(map(repr, TRANSFORMS))}; got "
                f"{variant!r}; choose one of these"
            )
        self.theta_true = torch.as_tensor(theta_true, dtype=torch.float32)
        if self.theta_true.shape != (2,) or bool((self.theta_true.abs() > BOUND).any()):
            raise ValueError(
                f"expected theta_true of two numbers within [-5, 5]; got {theta_true}; "
                "choose another truth"
            )
        self.variant: Variant = variant
        self.prior = BoxUniform(-BOUND * torch.ones(2), BOUND * torch.ones(2))
        self.actions = DiscreteActions(torch.arange(-5, 5.5, 0.5), names=["xi"])
        self.simulator = SimulatorModel(
            TRANSFORMS[variant],
            noise=GaussianNoise(1.0),
            parameter_names=["theta_1", "theta_2"],
            channel_names=["x"],
        )

    def _options(self) -> dict[str, Any]:
        return {"variant": self.variant, "theta_true": self.theta_true}

    def reference(self, action: Tensor, x: Tensor) -> ExactPosterior:
        """Return the exact posterior given trials.

        Args:
            action: Shape (t, 1).
            x: Shape (t, 1).
        """
        return ExactPosterior(action, x, variant=self.variant)


def linear_mean(theta: Tensor, action: Tensor) -> Tensor:
    """Return the noise-free x of the paper's model, shape (n, 1)."""
    return theta[:, :1] * torch.exp(3 - action) + theta[:, 1:] * action


def sinh_mean(theta: Tensor, action: Tensor) -> Tensor:
    """Return the noise-free x with theta_1 stretched by a hyperbolic sine."""
    stretched = 5 * torch.sinh(theta[:, :1] / 2.5) / math.sinh(2)
    return stretched * torch.exp(3 - action) + theta[:, 1:] * action


def square_mean(theta: Tensor, action: Tensor) -> Tensor:
    """Return the noise-free x with theta_1 squared: its sign is lost."""
    squared = theta[:, :1] ** 2 / 2.5 - 5
    return squared * torch.exp(3 - action) + theta[:, 1:] * action


TRANSFORMS = {"linear": linear_mean, "sinh": sinh_mean, "square": square_mean}
