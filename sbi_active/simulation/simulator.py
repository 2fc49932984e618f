"""Interface of a user's simulator, and checks of its output."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import all_finite, measured, own_tensor
from sbi_active.expected import require

FEW_VALUES = 4  # outcomes for each whole number among them, at least: they are counts


class Simulator(Protocol):
    """A user's simulator: draws from p(x | theta, action), one row a parameter set.

    A plain function will do. It may also accept ``seeds`` (shape (n,), int64), and then
    row i depends on ``seeds[i]`` alone.
    """

    def __call__(self, theta: Tensor, action: Tensor, /) -> Any:
        """Return x of shape (n, *x_shape), torch or NumPy.

        Args:
            theta: Parameters, shape (n, theta_dim), float32.
            action: Actions, shape (n, action_dim), float32.
        """
        ...


def outcome_tensor(
    x: Any, num_rows: int, *, dtype: torch.dtype | None = None
) -> Tensor:
    """Return a simulator's output as a tensor with one row a parameter set.

    It has memory of its own: a simulator may return the buffer that it works in.

    Args:
        x: Outcomes that the simulator returned.
        num_rows: Rows that it was given.
        dtype: Floating type to return; None keeps that of x.

    Raises:
        ValueError: If the output does not have ``num_rows`` rows of real numbers, or
            has a finite one beyond ``dtype``.
    """
    x = own_tensor(_outcome(x), dtype)
    require(
        x.ndim > 0 and len(x) == num_rows,
        f"x with one row a parameter set, shape ({num_rows}, ...)",
        tuple(x.shape),
        "return its rows stacked along axis 0, or wrap a function of one row, "
        "SimulatorModel(fn, batched=False)",
    )
    if x.ndim == 1:  # one number a row
        x = x[:, None]
    expected, got = "at least one number a row of x", f"shape {tuple(x.shape)}"
    advice = "return what was measured, and NaN where there is no measurement"
    require(x.shape[1:].numel() > 0, expected, got, advice)
    return x


def outcome_array(x: Any) -> np.ndarray:
    """Return the outcome of one row as float64, which may share the memory of x.

    Raises:
        RuntimeError: If there is none.
        ValueError: If it is no real numbers.
    """
    if type(x) is np.ndarray and x.dtype == np.float64:
        return x
    return measured(_outcome(x)).numpy()


def _outcome(x: Any) -> Any:
    """Return an outcome; that there is none counts as an exception of the simulator."""
    if x is None:
        raise RuntimeError(
            "expected an outcome from the simulator; got None; return x, with NaN "
            "where there is no measurement"
        )
    return x


def require_rows(theta: Tensor, action: Tensor) -> None:
    """Raise if parameters and actions are no finite rows (n, ...) of each other.

    Raises:
        ValueError: If a row is not finite; it names the first.
    """
    require(
        theta.ndim == action.ndim == 2 and len(theta) == len(action),
        "theta (n, theta_dim) and action (n, action_dim) with as many rows",
        f"{tuple(theta.shape)} and {tuple(action.shape)}",
        "repeat the action for each row",
    )
    for name, rows in (("theta", theta), ("action", action)):
        if not all_finite(rows):
            first = int(torch.nonzero(~rows.isfinite().all(1))[0, 0])
            got = f"{rows[first].tolist()} in row {first}"
            require(False, f"finite {name}", got, "remove NaN and inf")


def require_noise(x: Tensor, again: Tensor) -> None:
    """Raise if two seeds gave identical outcomes.

    Many counts and yes-or-no outcomes are equal by chance: a few whole numbers among
    many outcomes prove nothing.

    Args:
        x: Outcomes under one seed, shape (n, *x_shape).
        again: Outcomes of the same parameters and actions under another seed.

    Raises:
        ValueError: If no finite number of x differs.
    """
    both = x.isfinite() & again.isfinite()
    seen = x[both]
    if not len(seen) or not bool((seen == again[both]).all()):
        return
    different = seen.unique()
    is_counted = bool((different == different.round()).all())
    if not (is_counted and 1 < len(different) <= len(seen) / FEW_VALUES):
        raise ValueError(
            "expected a simulator with noise; got identical x from two seeds, and a "
            "deterministic simulator has neither a posterior density nor a finite "
            "information gain; declare the measurement noise, "
            "SimulatorModel(simulator, noise=GaussianNoise(sd))"
        )
