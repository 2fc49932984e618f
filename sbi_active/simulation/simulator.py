"""What users bring as a simulator, and what its output must look like."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "Simulator",
    "all_finite",
    "outcome_array",
    "outcome_tensor",
    "own_tensor",
    "require_noise",
]


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


def outcome_tensor(
    x: Any, num_rows: int, *, dtype: torch.dtype | None = None
) -> Tensor:
    """Return a simulator's output as a tensor with one row a parameter set.

    It has memory of its own: a simulator may return the buffer that it works in.

    Args:
        x: What the simulator returned.
        num_rows: Rows that it was given.
        dtype: Floating type to return; None keeps that of x.

    Raises:
        ValueError: If the output does not have ``num_rows`` rows of real numbers, or
            has a finite one beyond ``dtype``.
    """
    x = own_tensor(x, dtype)
    if x.ndim == 0 or x.shape[0] != num_rows:
        raise ValueError(
            f"expected x with one row a parameter set, shape ({num_rows}, ...); got "
            f"{tuple(x.shape)}; do return a simulator's rows stacked along axis 0"
        )
    if x.ndim == 1:  # one number a row
        x = x[:, None]
    if not x.shape[1:].numel():
        raise ValueError(
            f"expected at least one number a row of x; got shape {tuple(x.shape)}; "
            "return what was measured, and NaN where there is no measurement"
        )
    return x


def outcome_array(x: Any) -> np.ndarray:
    """Return the outcome of one row as float64, which may share the memory of x.

    Raises:
        ValueError: If a number is complex.
    """
    if type(x) is np.ndarray and x.dtype == np.float64:
        return x
    array = np.asarray(_filled(x))
    _require_real(array.dtype, array.dtype.kind == "c")
    return array.astype(np.float64, copy=False)


def own_tensor(x: Any, dtype: torch.dtype | None = None) -> Tensor:
    """Return real numbers as floating ones, in a tensor that shares no memory with x.

    Args:
        x: Anything that torch or NumPy takes for an array.
        dtype: Of the result; None keeps a floating one.

    Raises:
        ValueError: If a number is complex, or finite but beyond ``dtype``.
    """
    tensor = x if isinstance(x, Tensor) else _converted(x)
    _require_real(tensor.dtype, tensor.is_complex())
    if dtype is None:
        is_floating = tensor.is_floating_point()
        dtype = tensor.dtype if is_floating else torch.get_default_dtype()
    own = tensor.to(dtype, copy=tensor is x)
    if tensor.dtype == torch.float64 != dtype:
        _require_in_range(tensor, own)
    return own


def _require_real(dtype: Any, is_complex: bool) -> None:
    if is_complex:
        raise ValueError(
            f"expected x of real numbers; got {dtype}, whose imaginary part would be "
            "lost; return the real and the imaginary part as two numbers"
        )


def _require_in_range(x: Tensor, rounded: Tensor) -> None:
    """Raise where rounding made a measurement infinite."""
    if all_finite(rounded):
        return
    beyond = x.isfinite() & ~rounded.isfinite()
    if bool(beyond.any()):
        raise ValueError(
            "expected x within +-3.4e38, the range of float32; got "
            f"{x[beyond][0].item():g}, which would count as no measurement; return x "
            "in other units, or NaN where there is no measurement"
        )


def all_finite(x: Tensor) -> bool:
    """Return whether no number is NaN or infinite.

    A sum, several times as fast as asking each number, is finite only then.
    """
    return math.isfinite(x.sum()) or bool(x.isfinite().all())


def _converted(x: Any) -> Tensor:
    """Return numbers that are no tensor as one, in memory of its own."""
    x = _filled(x)
    first = x[0] if isinstance(x, list | tuple) and x else None
    if isinstance(first, Tensor):
        return torch.stack(list(x))
    if isinstance(first, np.ndarray) or hasattr(x, "__array__"):
        return _from_numpy(np.array(x, order="C"))
    tensor = torch.as_tensor(x)
    if tensor.is_floating_point():  # of Python's numbers, which have 64 bits
        _require_in_range(torch.as_tensor(x, dtype=torch.float64), tensor)
    return tensor


def _filled(x: Any) -> Any:
    """Return an outcome with NaN for masked numbers, which were not measured.

    Raises:
        RuntimeError: If there is none; it counts as an exception of the simulator.
    """
    if x is None:
        raise RuntimeError(
            "expected an outcome from the simulator; got None; return x, with NaN "
            "where there is no measurement"
        )
    if isinstance(x, np.ma.MaskedArray):
        return np.ma.filled(x.astype(np.float64), np.nan)
    return x


def _from_numpy(array: np.ndarray) -> Tensor:
    """Convert dtypes that torch refuses, too: of other bytes, precision or None."""
    if array.dtype == np.longdouble or array.dtype == object:
        array = array.astype(np.float64)
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), copy=False))


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
