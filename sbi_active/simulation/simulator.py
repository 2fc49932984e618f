"""What users bring as a simulator, and what its output must look like."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

__all__ = ["Simulator", "outcome_tensor", "require_noise"]


class Simulator(Protocol):
    """What users bring: a draw from p(x | theta, action), one row a parameter set.

    A plain function will do. It may also accept ``seeds`` (shape (n,), int64), and then
    row i depends on ``seeds[i]`` alone.
    """

    def __call__(self, theta: Tensor, action: Tensor, /) -> Any:
        """Return x of shape (n, *x_shape), torch or NumPy.

        Args:
            theta: Shape (n, theta_dim), float32.
            action: Shape (n, action_dim), float32.
        """
        ...


def outcome_tensor(x: Any, num_rows: int) -> Tensor:
    """Return a simulator's output as a tensor with one row a parameter set.

    Raises:
        ValueError: If the output does not have ``num_rows`` rows.
    """
    x = torch.as_tensor(x)
    if x.ndim == 0 or x.shape[0] != num_rows:
        raise ValueError(
            f"expected x with one row a parameter set, shape ({num_rows}, ...); got "
            f"{tuple(x.shape)}; do return a simulator's rows stacked along axis 0"
        )
    if x.ndim == 1:  # one number a row
        x = x[:, None]
    return x if x.is_floating_point() else x.to(torch.get_default_dtype())


def require_noise(x: Tensor, again: Tensor) -> None:
    """Raise where two seeds gave identical outcomes.

    Args:
        x: Outcomes under one seed, shape (n, *x_shape).
        again: Outcomes of the same parameters and actions under another seed.

    Raises:
        ValueError: If no finite number of x differs.
    """
    both = x.isfinite() & again.isfinite()
    if bool(both.any()) and bool((x[both] == again[both]).all()):
        raise ValueError(
            "expected a simulator with noise; got identical x from two seeds, and a "
            "deterministic simulator has neither a posterior density nor a finite "
            "information gain; do declare the measurement noise, "
            "SimulatorModel(simulator, noise=GaussianNoise(sd))"
        )
