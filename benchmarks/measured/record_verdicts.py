"""What the loop says of recorded trials: the one place that knows a report's layout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.criticism import Report
from sbi_active.criticism.results import NONE

__all__ = ["Found", "read_report"]

NUM_DRAWS = 64


@dataclass(frozen=True, kw_only=True)
class Found:
    """A verdict.

    Attributes:
        row: Plain figures for the results.
        helps: Names of the effects that are said to predict better.
        before: Draws of theta of the bare model, shape (n, theta_dim), float64.
        after: Draws of theta and strengths of the effects that help, shape (n, d).
        text: The report's first paragraph.
    """

    row: dict[str, Any]
    helps: tuple[str, ...]
    before: Tensor
    after: Tensor
    text: str


def read_report(report: Report, theta_dim: int) -> Found:
    """Return what a report says.

    Args:
        report: Of ``close_loop``.
        theta_dim: Parameters of the bare simulator. Columns of draws beyond these and
            the strengths, those of nuisances, are left out.
    """
    tracing, detection = report.tracing, report.detection
    helps = tracing.chosen
    sizes = {e.name: len(e.mean) for e in tracing.estimates}
    num = theta_dim + sum(sizes[name] for name in helps)
    after = tracing.evidences.get(" + ".join(helps) or NONE, tracing.evidences[NONE])
    row = {
        "verdict": tracing.verdict,
        "alarm": bool(detection.alarm),
        "log_bayes_factor": float(detection.log_bayes_factor),
        "cause": {name: float(p) for name, p in tracing.inclusion.items()},
        "probabilities": {n: float(p) for n, p in tracing.probabilities.items()},
        "credible_set": [*tracing.credible_set],
        "near": [sorted(group) for group in tracing.near],
        "warnings": [*report.warnings],
        "parameters": {
            name: [float(z.mean()), float(z.std())]
            for name, z in zip(after.names, after.draws.T, strict=True)
        },
    }
    return Found(
        row=row,
        helps=helps,
        before=_some(tracing.evidences[NONE].draws, theta_dim),
        after=_some(after.draws, num),
        text=str(report).split("\n\n")[0],
    )


def _some(draws: np.ndarray, columns: int) -> Tensor:
    at = np.linspace(0, len(draws) - 1, min(NUM_DRAWS, len(draws))).astype(int)
    return torch.from_numpy(draws[at, :columns]).double()
