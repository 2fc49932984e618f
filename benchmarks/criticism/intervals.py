"""Binomial intervals and the calibration of stated probabilities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest


def rate(hits: Sequence[bool] | np.ndarray) -> str:
    """Return a proportion with its counts and Wilson's 95 % interval, for a table."""
    n, k = len(hits), int(np.sum(hits))
    if n == 0:
        return "- (0 cases)"
    ends = binomtest(k, n).proportion_ci(method="wilson")
    return f"{k / n:.3f} ({k}/{n}) [{ends.low:.3f}, {ends.high:.3f}]"


def brier_score(
    probabilities: Sequence[dict[str, float]], truth: Sequence[str]
) -> float:
    r"""Return the mean of :math:`\sum_k (p_k - 1_{k = truth})^2`, between 0 and 2."""
    scores = []
    for stated, name in zip(probabilities, truth, strict=True):
        wrong = sum((p - (k == name)) ** 2 for k, p in stated.items())
        scores.append(wrong + (name not in stated))
    return float(np.mean(scores))


def reliability(
    probabilities: Sequence[dict[str, float]],
    truth: Sequence[str],
    *,
    edges: Sequence[float] = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0),
) -> list[tuple[float, float, int]]:
    """Return mean stated probability, share that is true, and count, a bin each."""
    stated, hit = [], []
    for row, name in zip(probabilities, truth, strict=True):
        stated += [*row.values()]
        hit += [k == name for k in row]
    stated, hit = np.array(stated), np.array(hit)
    where = np.clip(np.searchsorted(edges, stated, side="right") - 1, 0, len(edges) - 2)
    return [
        (float(stated[where == b].mean()), float(hit[where == b].mean()), int(n))
        for b in range(len(edges) - 1)
        if (n := (where == b).sum())
    ]
