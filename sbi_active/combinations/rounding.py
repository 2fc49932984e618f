"""The roundest weights that say about as much as the best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.combinations.formula import SIMPLE, Combination, Term

Array = NDArray[Any]

#: A formula may be wider than the best one by this factor and be preferred as simpler.
AS_GOOD = 1.1


def width(weight: Array, covariance: Array, prior: Array) -> float:
    """Return the standard deviation of a combination in those of the prior."""
    size = weight @ prior @ weight
    return float(np.sqrt(max(weight @ covariance @ weight, 0.0) / size))


def rounded(
    terms: Sequence[Term], weight: Array, covariance: Array, prior: Array, floor: float
) -> Combination:
    """Return the combination of the roundest weights that are about as narrow.

    The first weight is 1; each of the others is rounded in turn, and those after it are
    fitted again.
    """
    limit = max(AS_GOOD * width(weight, covariance, prior), floor)
    size = np.abs(weight) * np.sqrt(prior.diagonal())
    first = 0 if size[0] > 0.1 * size.max() else int(size.argmax())
    weight = weight / weight[first]
    order = [k for k in range(len(weight)) if k != first]
    for place, k in enumerate(order):
        free = order[place + 1 :]
        for value in (0.0, *roundings(float(weight[k]))):
            if value == 0.0 and len(weight) < 4:
                continue
            tried = weight.copy()
            tried[k] = value
            if free:
                fixed = [j for j in range(len(weight)) if j not in free]
                right = covariance[np.ix_(free, fixed)] @ tried[fixed]
                own = covariance[np.ix_(free, free)]
                ridge = 1e-12 * np.trace(own) * np.eye(len(free))
                tried[free] = -np.linalg.solve(own + ridge, right)
            if width(tried, covariance, prior) <= limit:
                break
        weight = tried
    halves = 2 * weight
    if (
        all(t.log for t in terms)
        and (halves % 1 == 0).all()
        and (weight % 1 != 0).any()
    ):
        weight = halves  # a^2 * b rather than a * b^0.5
    kept = [
        replace(t, weight=float(w)) for t, w in zip(terms, weight, strict=True) if w
    ]
    return Combination(tuple(kept))


def roundings(value: float) -> Iterator[float]:
    """Return numbers near a value, the roundest first, itself to four digits last."""
    sign = np.sign(value) or 1.0
    for simple in SIMPLE:
        if 0.5 < abs(value) / simple < 2:
            yield float(sign * simple)
    for digits in (1, 2, 3, 4):
        yield float(f"{value:.{digits}g}")
