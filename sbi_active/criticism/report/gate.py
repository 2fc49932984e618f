"""Whether a simulator may be used, decided on trials that had no part in its fit.

The first of these conditions that holds decides: too few trials, a bound of the prior,
an effect that is missing or a residual, parameters that the trials leave open. If none
holds, the simulator predicts trials that it was not fitted to within their errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.summary import not_told_from
from sbi_active.criticism.report.words import listed, number, stated
from sbi_active.criticism.results import NONE, OUTLIER, ModelKey

Decision = Literal[
    "SHIP",
    "NO_IMPROVEMENT",
    "NOT_IDENTIFIABLE",
    "OUT_OF_PRIOR",
    "WRONG_MODEL",
    "NOT_ENOUGH_DATA",
]
#: Exit status of a process by decision; 1 and 2 are those of failures and misuse.
EXIT_CODES: dict[Decision, int] = {
    "SHIP": 0,
    "NO_IMPROVEMENT": 10,
    "NOT_IDENTIFIABLE": 11,
    "OUT_OF_PRIOR": 12,
    "WRONG_MODEL": 13,
    "NOT_ENOUGH_DATA": 14,
}


@dataclass(frozen=True, kw_only=True)
class GateSettings:
    """Settings of the gate.

    Attributes:
        fewest: Trials that have to be scored.
        level: Tail probability of the chi-square of the scored trials below which the
            simulator misses them, as for held-out trials of a verdict.
        covered: Share of numbers within their 90 % intervals below which it misses
            them, if the size of the noise is not declared.
        open: Width of a posterior, in prior deviations, above which a parameter is
            hardly known.
        likely: Probability of the bare model below which trials decide nothing, though
            they raise no alarm.
        kept: Share of a bound that a wider one keeps, where it would change its sign.
    """

    fewest: int = 3
    level: float = 0.01
    covered: float = 0.7
    open: float = 0.5
    likely: float = 0.2
    kept: float = 0.1


GATE = GateSettings()


@dataclass(frozen=True)
class Gate:
    """Decision on a simulator.

    Attributes:
        decision: "SHIP", or the first reason not to.
        reason: A sentence.
        details: Effects to add, trials that are missed, bounds to move, combinations.
    """

    decision: Decision
    reason: str
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """Exit status of a process: 0 to ship, 10 to 14 otherwise."""
        return EXIT_CODES[self.decision]

    def to_dict(self) -> dict[str, Any]:
        """Return the gate as JSON has it."""
        return {**asdict(self), "exit_code": self.exit_code}

    def __str__(self) -> str:
        return f"{self.decision}: {self.reason}"


def gate_of(report: Contents) -> Gate:
    """Return the decision on the simulator that a report is of.

    Args:
        report: Report with the error before and after.
    """
    return next(_conditions(report))


def _conditions(report: Contents) -> Iterator[Gate]:
    """Yield the decisions whose conditions hold, the first that decides first."""
    tracing, scored = report.tracing, report.evaluation
    num = 0 if scored is None else len(scored.trials)
    if scored is None or num < GATE.fewest:
        yield Gate(
            "NOT_ENOUGH_DATA",
            f"{num} trials were scored that had no part in the fit, and {GATE.fewest} "
            "are needed; measure more",
            {"scored": num},
        )
        return
    yield from _beyond_prior(report)
    if report.verdict == OUTLIER:
        yield Gate(
            "NOT_ENOUGH_DATA",
            "one trial does not agree with the others; check and repeat it",
            {"trials": [tracing.trial_names.get(i, i) for i in tracing.outliers][:1]},
        )
    before, after = report.rmse
    errors = {"before": before, "after": after}
    if report.verdict != NONE:
        yield from _wrong(report, errors)
    missed = [trial.name for trial in scored.missed]
    inside = scored.after["coverage"] if report.verdict == NONE else np.ones(1)
    uncovered = np.isnan(scored.p_value) and np.mean(inside) < GATE.covered
    if missed or scored.p_value < GATE.level or uncovered:
        which = f"trials {listed(missed)}" if missed else f"the {num} scored trials"
        yield Gate(
            "WRONG_MODEL",
            f"{which} are far outside what the simulator predicts",
            {"trials": missed, **_residuals(report)},
        )
    if found := report.combinations:
        yield Gate("NOT_IDENTIFIABLE", str(found), {"combinations": found.to_dict()})
    if wide := _open(report):
        yield Gate(
            "NOT_ENOUGH_DATA",
            f"the trials hardly tell {listed(wide)}; measure more",
            {"parameters": wide},
        )
    p = report.probabilities.get(NONE, 1.0)
    if p < GATE.likely:
        other = max(report.probabilities, key=report.probabilities.__getitem__)
        told = f"no alarm, though {other} is likelier ({stated(p)} for none)"
        yield Gate("NOT_ENOUGH_DATA", f"{told}; measure more", {"effects": [other]})
    yield Gate(
        "SHIP",
        f"the simulator predicts {num} trials that had no part in its fit, with a root "
        f"mean square error of {number(errors['before'])}",
        {"scored": num, **errors},
    )


def _beyond_prior(report: Contents) -> Iterator[Gate]:
    """Yield that the prior is too narrow, if a wider one explains the trials."""
    bounds = report.tracing.bounds
    explains = bool(bounds.replaces) or bounds.p_value > GATE.level
    found = {(p.name, p.side): p for p in bounds.parameters if p.model == NONE}
    moved = [*found.values()]
    if not (moved and explains and report.detection.alarm):
        return
    said = [f"{p.name} at its {p.side} bound {p.bound:.6g}" for p in moved]
    box: dict[str, dict[str, float]] = {}
    for p in moved:
        wider = p.bound + 2 * (p.beyond - p.bound)  # as much again beyond the fit
        keeps_sign = wider * p.bound >= 0
        end = wider if keeps_sign else GATE.kept * p.bound
        box.setdefault(p.name, {})[p.side] = end
    ends = [f"{name}: {v:.4g}" for name, side in box.items() for v in side.values()]
    yield Gate(
        "OUT_OF_PRIOR",
        f"{listed(said)}, and with a wider prior no effect is needed; widen it to "
        f"{', '.join(ends)}",
        {"bounds": [asdict(p) for p in moved], "box": box},
    )


def _wrong(report: Contents, errors: dict[str, float]) -> Iterator[Gate]:
    """Yield that effects do not lower the error, or that something is missing."""
    tracing, effects = report.tracing, [*report.tracing.chosen]
    no_better = not errors["after"] < errors["before"]
    if tracing.refuted or (effects and no_better):
        before, after = tracing.refuted or (errors["before"], errors["after"])
        name = tracing.instead_of or str(ModelKey(tracing.chosen))
        yield Gate(
            "NO_IMPROVEMENT",
            f"{name} does not lower the error on trials that had no part in the fit: "
            f"{number(before)} to {number(after)}",
            {"effects": effects, "before": before, "after": after},
        )
        return
    others = not_told_from(tracing, effects)
    where = _residuals(report)
    if effects and not tracing.beside:
        told = f"the simulator lacks {report.verdict}"
        if others:
            told += f", or {', '.join(others)}, which no permitted action tells from it"
        change = f"{number(errors['before'])} to {number(errors['after'])}"
        reason = f"{told}; with it the error goes from {change}; add it and ask again"
    else:
        helping = f"; {ModelKey(tracing.beside)} helps" if tracing.beside else ""
        reason = (
            f"the simulator misses the trials ({report.verdict}){helping}; most in "
            f"trial {where['worst']['trial']}"
        )
    yield Gate(
        "WRONG_MODEL", reason, {"effects": effects, "or": others, **errors, **where}
    )


def _residuals(report: Contents) -> dict[str, Any]:
    """Return the trial, channel and time of the largest residual."""
    table = report.residuals_by_trial.head(1).dropna(axis="columns")
    return {"worst": next(iter(table.to_dict("records")), {})}


def _open(report: Contents) -> list[str]:
    """Return the parameters that the trials hardly tell."""
    evidence = report.tracing.evidences[NONE]
    prior = report.prior_draws("gate")
    dim = min(prior.shape[1], evidence.draws.shape[1])
    width = evidence.draws[:, :dim].std(0) / prior[:, :dim].std(0)
    return [n for n, w in zip(evidence.names, width, strict=False) if w > GATE.open]
