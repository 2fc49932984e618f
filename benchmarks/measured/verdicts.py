"""What the loop says of recorded trials: the one place that knows a report's layout."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism import Report
from sbi_active.criticism.results import NONE, Evidence, Tracing

#: What a report's first paragraph says of an effect that is named.
SHARE_LEFT = re.compile(r"\d+ %\s+of\s+the\s+excess")


def row_of(tracing: Tracing) -> dict[str, Any]:
    """Return a verdict as plain figures."""
    misfit, helps = tracing.misfit, tracing.chosen
    support = {} if misfit is None else misfit.support
    model = tracing.evidences.get(" + ".join(helps) or NONE, tracing.evidences[NONE])
    return {
        "verdict": tracing.verdict,
        "named": [*(helps if misfit is None else misfit.named)],
        "helps": [*helps],
        "open_forms": {} if misfit is None else misfit.open_forms,
        "inclusion": {name: float(p) for name, p in tracing.inclusion.items()},
        "support": {
            name: [own.inclusion, own.gained, own.remains]
            for name, own in support.items()
        },
        "probabilities": {n: float(p) for n, p in tracing.probabilities.items()},
        "credible_set": [*tracing.credible_set],
        "near": [sorted(group) for group in tracing.near],
        "log_evidence": {k: e.log_evidence for k, e in tracing.evidences.items()},
        "parameters": spreads(model),
    }


def read_report(report: Report) -> dict[str, Any]:
    """Return what a report says as plain figures."""
    return row_of(report.tracing) | {
        "line": str(report).splitlines()[0],
        "text": str(report).split("\n\n")[0],
        "alarm": bool(report.detection.alarm),
        "log_bayes_factor": float(report.detection.log_bayes_factor),
        "warnings": [*report.warnings],
    }


def spreads(evidence: Evidence) -> dict[str, list[float]]:
    """Return mean and standard deviation of each parameter of a model."""
    pairs = zip(evidence.names, evidence.draws.T, strict=True)
    return {name: [float(z.mean()), float(z.std())] for name, z in pairs}


def center(evidence: Evidence, columns: int | None = None) -> Tensor:
    """Return the best fit where every model misses, as the library predicts by it.

    Draws as wide as misfit asks leave the valley that the best fit lies in.

    Args:
        evidence: Evidence of the model.
        columns: Number of its parameters and strengths; None for all, (1, columns).
    """
    best = evidence.draws.mean(0) if evidence.best is None else evidence.best
    return torch.from_numpy(best[None, :columns]).double()


def said(row: Mapping[str, Any]) -> str:
    """Return the verdict of a row, and what else helps to predict."""
    beside = [name for name in row["helps"] if name not in row["named"]]
    forms = [f"{n}: {family}" for n, family in row.get("open_forms", {}).items()]
    told = row["verdict"] + (f" (form open, {', '.join(forms)})" if forms else "")
    return told + (f", {' + '.join(beside)} helps" if beside else "")


def causes(row: Mapping[str, Any]) -> str:
    """Return the share of the excess that each effect that helps leaves."""
    support = row.get("support", {})
    return ", ".join(f"{n} {100 * left:.0f} %" for n, (*_, left) in support.items())


def shares_left(row: Mapping[str, Any]) -> bool:
    """Return whether a row's text says which share of the excess is left."""
    return SHARE_LEFT.search(row["text"]) is not None
