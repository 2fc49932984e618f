"""What the loop says of recorded trials: the one place that knows a report's layout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.criticism import Report
from sbi_active.criticism.results import NONE, Evidence
from sbi_active.criticism.under_misfit import ModelError

__all__ = ["Found", "center", "read_report"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """A verdict.

    Attributes:
        row: Plain figures for the results.
        helps: Names of the effects that are said to predict better.
        before: Best theta of the bare model, shape (1, theta_dim), float64.
        after: The same of theta and the strengths of the effects that help, (1, d).
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
    tracing, detection, misfit = report.tracing, report.detection, report.tracing.misfit
    helps = tracing.chosen
    sizes = {e.name: len(e.mean) for e in tracing.estimates}
    num = theta_dim + sum(sizes[name] for name in helps)
    after = tracing.evidences.get(" + ".join(helps) or NONE, tracing.evidences[NONE])
    cause = tracing.inclusion if misfit is None else misfit.cause
    row = {
        "verdict": tracing.verdict,
        "line": str(report).splitlines()[0],
        "alarm": bool(detection.alarm),
        "log_bayes_factor": float(detection.log_bayes_factor),
        "named": [*(helps if misfit is None else misfit.named)],
        "cause": {name: float(cause.get(name, 0.0)) for name in tracing.inclusion},
        "models": [] if misfit is None else [_model(m) for m in misfit.models],
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
        before=center(tracing.evidences[NONE], theta_dim),
        after=center(after, num),
        text=str(report).split("\n\n")[0],
    )


def _model(model: ModelError) -> dict[str, Any]:
    return {
        "name": model.name,
        "probability": float(model.probability),
        "left_out": np.asarray(model.left_out).tolist(),
        "remains": float(model.remains),
    }


def center(evidence: Evidence, columns: int | None = None) -> Tensor:
    """Return the best fit where every model misses, as the library predicts by it.

    Draws as wide as misfit asks leave the valley that the best fit lies in.

    Args:
        evidence: Of the model.
        columns: How many of its parameters and strengths; None for all, (1, columns).
    """
    best = evidence.draws.mean(0) if evidence.best is None else evidence.best
    return torch.from_numpy(best[None, :columns]).double()
