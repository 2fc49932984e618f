"""Location finding as a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active.actions import DiscreteActions
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.location_finding.model import NOISE_SD, log_likelihood, mean

__all__ = ["LocationFindingTask"]

#: Half-width and spacing of the default grid of actions.
REACH, SPACING = 3.0, 0.25


class LocationFindingTask(Task):
    r"""Find hidden sources by measuring their signal at places of our choice.

    Model and reference stand in :mod:`.model`. The
    action is a place in the plane; ``actions`` is a grid over [-3, 3]^2, which any set
    of places may replace.

    The task is a model itself, with the exact ``log_likelihood``.

    Args:
        num_sources: K; 2 in the benchmark.
        theta_true: Places of the sources one after another, shape (2 K,); None is (1,
            -.5) and (-.75, .5) for two sources, and the like for other numbers.

    Raises:
        ValueError: If there is no source, or ``theta_true`` has another length.

    Example:
        >>> task = LocationFindingTask()
        >>> task.parameter_names
        ['source_1_x', 'source_1_y', 'source_2_x', 'source_2_y']
        >>> task.simulator.mean(task.theta_true[None], torch.tensor([[1.0, -0.5]]))
        tensor([[9.2104]])
    """

    name = "location_finding"
    exact_likelihood = True

    def __init__(
        self,
        *,
        num_sources: int = 2,
        theta_true: Sequence[float] | Tensor | None = None,
    ) -> None:
        if num_sources < 1:
            raise ValueError(
                f"expected num_sources >= 1; got {num_sources}; place one at least"
            )
        if theta_true is None:
            pattern = torch.tensor([1.0, -0.5, -0.75, 0.5])
            theta_true = pattern.repeat(num_sources)[: 2 * num_sources]
        self.theta_true = torch.as_tensor(theta_true, dtype=torch.float32)
        if self.theta_true.shape != (2 * num_sources,) or not bool(
            self.theta_true.isfinite().all()
        ):
            raise ValueError(
                f"expected theta_true of {2 * num_sources} finite numbers, two a "
                f"source; got {theta_true}; choose another truth"
            )
        self.num_sources = num_sources
        dim = 2 * num_sources
        self.prior = MultivariateNormal(torch.zeros(dim), torch.eye(dim))
        line = torch.arange(-REACH, REACH + SPACING / 2, SPACING)
        self.actions = DiscreteActions(
            torch.cartesian_prod(line, line), names=["place_x", "place_y"]
        )
        self.simulator = SimulatorModel(
            mean,
            noise=GaussianNoise(NOISE_SD),
            parameter_names=[
                f"source_{k + 1}_{axis}" for k in range(num_sources) for axis in "xy"
            ],
            channel_names=["log_signal"],
        )

    def _options(self) -> dict[str, Any]:
        return {"num_sources": self.num_sources, "theta_true": self.theta_true}

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return the exact log likelihood of rows.

        Args:
            x: Shape (n, 1).
            theta: Shape (n, 2 K).
            action: Shape (n, 2).

        Returns:
            Shape (n,), float64, nats.
        """
        return log_likelihood(x, theta, action)
