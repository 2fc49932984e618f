"""Scores of one case, from the public report and the truth alone."""

from __future__ import annotations

import copy
import functools
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from torch import Tensor

from benchmarks.criticism.cases import Case
from benchmarks.criticism.oracle import oracle_rmse
from sbi_active import SimulatorModel
from sbi_active.criticism import Report
from sbi_active.criticism.under_misfit import UNDECLARED

COLUMNS = [
    *["case", "effects", "strengths", "theta", "correlation", "lambda", "support"],
    *["verdict", "probabilities", "credible_set", "equivalent", "formula"],
    "undeclared",
    *["rmse_before", "rmse_after", "rmse_oracle", "coverage_before", "coverage_after"],
    *["engine", "warnings", "trial_simulations", "cpu_seconds", "failure"],
]


def counted(model: SimulatorModel) -> tuple[SimulatorModel, Callable[[], int]]:
    """Return a copy of the model that counts its rows, and how to read the count."""
    rows, fn = 0, model.fn

    @functools.wraps(fn)
    def counting(theta: Tensor, *arguments: Any, **keywords: Any) -> Any:
        nonlocal rows
        rows += len(theta)
        return fn(theta, *arguments, **keywords)

    twin = copy.copy(model)
    twin.fn = counting
    return twin, lambda: rows


def score_case(case: Case, number: int, *, oracle: bool = False) -> dict[str, object]:
    """Run the loop on a case and return its row of the results.

    Args:
        case: The case.
        number: Its number, also the loop's seed.
        oracle: Also score the model that is given the true effect.
    """
    problem, truth = case.problem, case.truth
    row: dict[str, object] = dict.fromkeys(COLUMNS, "")
    row |= {
        "case": number,
        "effects": " + ".join(truth.names) or "none",
        "strengths": " ".join(f"{float(s):.6g}" for s in truth.strengths),
        "theta": " ".join(f"{v:.6g}" for v in truth.theta[0].tolist()),
        "correlation": truth.correlation,
        "lambda": truth.non_centrality,
        "support": _support(case),
    }
    model, count = counted(problem.model)
    start = time.process_time()
    try:
        # No table needs a plan but that of active choice.
        report = replace(problem, model=model).report(number, plan=False)
    except Exception as error:  # a crash is a result of the benchmark
        return row | {"failure": f"{type(error).__name__}: {error}"[:300]}
    row |= {
        "cpu_seconds": time.process_time() - start,
        "trial_simulations": count(),
    }
    if oracle and problem.trials.held_out is not None:
        row["rmse_oracle"] = oracle_rmse(case)
    return row | read_report(report)


def _support(case: Case) -> float | str:
    """Return what data say against less than both effects, or against the declared."""
    if len(case.truth.effects) > 1:
        return case.truth.support
    if case.truth.kind in ("removed", "inexpressible") and case.problem.effects:
        return case.truth.left_by_any(case.problem.effects)
    return ""


def read_report(report: Report) -> dict[str, object]:
    """Return a report's public figures as cells."""
    row: dict[str, object] = {
        "verdict": report.verdict,
        "probabilities": json.dumps(
            {k: round(float(p), 6) for k, p in report.probabilities.items()}
        ),
        "credible_set": json.dumps([*report.credible_set]),
        "equivalent": json.dumps([sorted(group) for group in report.equivalent]),
        "formula": report.guess or "",
        "undeclared": int(UNDECLARED in repr(report)),
        "warnings": len(report.warnings),
    }
    for metric, before, after, *_ in report.before_after.itertuples(index=False):
        if metric in ("rmse", "coverage"):
            row |= {f"{metric}_before": before, f"{metric}_after": after}
    return row
