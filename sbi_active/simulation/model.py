"""A simulator with its noise, names and way of taking seeds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from sbi_active.simulation.noise import NoiseModel

__all__ = ["Simulator", "SimulatorModel", "require_noise", "takes_seeds"]


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


class SimulatorModel:
    r"""A simulator that owns its noise, :math:`x = f(\theta, \xi) + \epsilon`.

    Args:
        fn: ``fn(theta, action)``, shapes (n, theta_dim) and (n, action_dim), giving
            (n, *x_shape); it may accept ``seeds``.
        noise: Added to the output of ``fn``; None where ``fn`` is itself the draw.
        parameter_names: One a parameter.
        channel_names: One an entry of x's last axis.

    Example:
        >>> from sbi_active.simulation import GaussianNoise
        >>> model = SimulatorModel(lambda theta, xi: theta * xi, noise=GaussianNoise(1))
        >>> model.mean(torch.ones(2, 1), torch.tensor([[2.0], [3.0]])).tolist()
        [[2.0], [3.0]]
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        *,
        noise: NoiseModel | None = None,
        parameter_names: Sequence[str] | None = None,
        channel_names: Sequence[str] | None = None,
    ) -> None:
        self.fn = fn
        self.noise = noise
        self.parameter_names = None if parameter_names is None else [*parameter_names]
        self.channel_names = None if channel_names is None else [*channel_names]
        self.fn_takes_seeds = takes_seeds(fn)

    def __call__(
        self, theta: Tensor, action: Tensor, seeds: Tensor | None = None
    ) -> Tensor:
        """Return one draw a row.

        Args:
            theta: Shape (n, theta_dim).
            action: Shape (n, action_dim).
            seeds: One a row, shape (n,); None uses torch's global generator.

        Returns:
            Shape (n, *x_shape).
        """
        x = self._run(theta, action, seeds)
        return x if self.noise is None else self.noise.sample(x, seeds)

    def mean(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return the noise-free output, shape (n, *x_shape).

        Raises:
            ValueError: If the model was built without a noise model, since ``fn`` is
                then the draw itself.
        """
        if self.noise is None:
            raise ValueError(
                "expected a simulator with a noise model; got noise=None, so the "
                "output of fn is already a random draw; do build "
                "SimulatorModel(fn, noise=GaussianNoise(sd)) around a noise-free fn"
            )
        return self._run(theta, action, None)

    def _run(self, theta: Tensor, action: Tensor, seeds: Tensor | None) -> Tensor:
        if self.fn_takes_seeds and seeds is not None:
            return outcome_tensor(self.fn(theta, action, seeds=seeds), len(theta))
        return outcome_tensor(self.fn(theta, action), len(theta))


def takes_seeds(simulator: Callable[..., Any]) -> bool:
    """Return whether each row of the simulator is a function of its seed."""
    if isinstance(simulator, SimulatorModel):
        return simulator.fn_takes_seeds
    try:
        return "seeds" in inspect.signature(simulator).parameters
    except (TypeError, ValueError):  # builtins and C functions have no signature
        return False


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
