"""Numbers as users bring them, as tensors that nobody else holds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: An array of numbers of any kind.
Array = NDArray[Any]


def own_tensor(
    value: Any,
    dtype: torch.dtype | None = None,
    *,
    name: str = "x",
    copy: bool = True,
) -> Tensor:
    """Return real numbers as floating ones, in a tensor that shares no memory.

    Args:
        value: A number, tensor, array, or nested sequences of them; NaN stands for
            what a masked array masks, and for None among other numbers.
        dtype: Type of the result; None keeps a floating one.
        name: Name of the numbers, for errors.
        copy: Whether a tensor of this type is copied as well.

    Raises:
        ValueError: If they are no real numbers, but complex, text, dates or None; if
            rows differ in length; or if one is finite but beyond ``dtype``.
    """
    tensor = value if isinstance(value, Tensor) else _converted(value, name)
    if tensor.is_complex():
        raise ValueError(
            f"expected {name} of real numbers; got {tensor.dtype}, whose imaginary "
            "part would be lost; pass real and imaginary part as two numbers"
        )
    if dtype is None:
        keeps = tensor.is_floating_point() and not _is_of_python(value)
        dtype = tensor.dtype if keeps else torch.get_default_dtype()
    own = tensor.to(dtype, copy=copy and tensor is value)
    if tensor.dtype == torch.float64 != dtype and not all_finite(own):
        beyond = tensor.isfinite() & ~own.isfinite()
        if bool(beyond.any()):
            raise ValueError(
                f"expected {name} within +-3.4e38, the range of float32; got "
                f"{tensor[beyond][0].item():g}, which would become infinite; pass it "
                "in other units, or NaN where there is no measurement"
            )
    return own


def measured(
    value: Any, dtype: torch.dtype = torch.float64, *, name: str = "x"
) -> Tensor:
    """Return real numbers on the CPU, apart from any graph.

    Args:
        value: Numbers, as :func:`own_tensor` takes them.
        dtype: Type of the result.
        name: Name of the numbers, for errors.

    Raises:
        ValueError: If :func:`own_tensor` refuses the value.
    """
    with torch.inference_mode(False):  # tensors of that mode are barred from training
        return own_tensor(value, dtype, name=name).detach().cpu()


def all_finite(x: Tensor) -> bool:
    """Return whether no number is NaN or infinite.

    It takes a sum, which is finite only then, and is several times as fast as a test of
    each number.
    """
    return math.isfinite(x.sum()) or bool(x.isfinite().all())


def finite(x: Tensor) -> Tensor:
    """Return which numbers are neither NaN nor infinite, bool, of the shape of x.

    NumPy's test takes no copy of the numbers, as torch's does.
    """
    if x.device.type != "cpu" or x.requires_grad:
        return x.isfinite()
    return torch.from_numpy(np.asarray(np.isfinite(x.numpy())))


def _converted(value: Any, name: str) -> Tensor:
    """Return numbers that are no tensor as one; dtypes that torch refuses, too."""
    try:
        is_list = isinstance(value, list | tuple)
        if is_list and any(isinstance(part, Tensor) for part in value):
            return torch.stack([torch.as_tensor(part) for part in value])
        array = np.array(value, order="C", subok=True)
        if value is None or array.dtype.kind not in "biufcO":
            raise TypeError("not numbers")
        if array.dtype.kind != "c":
            if isinstance(array, np.ma.MaskedArray):
                array = np.ma.filled(array.astype(np.float64), np.nan)
            if array.dtype == np.longdouble or array.dtype == object:
                array = array.astype(np.float64)
        array = array.astype(array.dtype.newbyteorder("="), copy=False, subok=False)
        return torch.from_numpy(array)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(
            f"expected {name} of real numbers; got {value!r:.80} ({error}); pass a "
            "number, or an array or tensor of them, with rows of one length"
        ) from None


def _is_of_python(value: Any) -> bool:
    """Return whether numbers are Python's own, whose 64 bits are no choice."""
    while isinstance(value, list | tuple) and value:
        value = value[0]
    return type(value) in (int, float, bool, list, tuple)


def distance_from(places: Tensor, rows: Tensor, *, same: float = 1e-6) -> Tensor:
    """Return the distance of rows from the nearest of some places, shape (n,).

    Args:
        places: Other rows, shape (t, d).
        rows: Rows, shape (n, d); distances are in their ranges.
        same: Distance below which two rows are the same, at a distance of 0.
    """
    rows, places = rows.double(), places.double()
    width = rows.max(0).values - rows.min(0).values
    width = torch.where(width > 0, width, torch.ones_like(width))
    # By products of matrices what is the same is 1e-5 apart, far from 0 in its ranges.
    exact = "donot_use_mm_for_euclid_dist"
    apart = torch.cdist(rows / width, places / width, compute_mode=exact)
    distance = apart.min(1).values
    return torch.where(distance < same, 0.0, distance)
