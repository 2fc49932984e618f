"""Whether a simulator may be used, decided on trials that had no part in its fit.

The first of these conditions that holds decides: too few trials, a bound of the prior,
an effect that is missing or a residual, parameters that the trials leave open. If none
holds, the simulator predicts trials that it was not fitted to within their errors.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import binom

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.words import blocks
from sbi_active.criticism.results import NONE, OUTLIER
from sbi_active.criticism.rivals.rival import surprising_outcomes
from sbi_active.criticism.steps.detection import TOO_SMALL

#: Exit status of a process by decision; 1 and 2 are those of failures and misuse.
EXIT_CODES = {
    "SHIP": 0,
    "NO_IMPROVEMENT": 10,
    "NOT_IDENTIFIABLE": 11,
    "OUT_OF_PRIOR": 12,
    "WRONG_MODEL": 13,
    "NOT_ENOUGH_DATA": 14,
}


@dataclass(frozen=True)
class Gate:
    """Decision on a simulator.

    Attributes:
        decision: "SHIP", or the first reason not to.
        reason: A sentence.
        details: Effects to add, trials that are missed, bounds to move, combinations.
    """

    decision: str
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


def gate_of(
    report: Contents,
    *,
    fewest: int = 3,
    level: float = 0.01,
    covered: float = 0.7,
    likely: float = 0.2,
    hides: float = 0.5,
) -> Gate:
    """Return the decision on the simulator that a report is of.

    Args:
        report: Report with the error before and after.
        fewest: Trials that have to be scored.
        level: Tail probability of the chi-square of the scored trials below which the
            simulator misses them, as for held-out trials of a verdict.
        covered: Share of numbers within their 90 % intervals below which it misses
            them, if no chi-square tells and it is less than ``level`` lets: of three
            single numbers one is outside in a third of right sets.
        likely: Probability of the bare model below which trials decide nothing, though
            they raise no alarm.
        hides: Share of the declared variance in the residuals below which the noise is
            declared so large that more may hide in it than is left: half of it.
    """
    scored, decide = report.evaluation, partial(_decided, report)
    num = 0 if scored is None else len(scored.names)
    if num >= fewest and (narrow := _beyond_prior(report, level)) is not None:
        return narrow
    if report.verdict == OUTLIER:
        trials = report.called(report.tracing.outliers)[:1]
        return decide("NOT_ENOUGH_DATA", "contradicts", {"trials": trials})
    if scored is None or num < fewest:
        return decide("NOT_ENOUGH_DATA", "scored", {"scored": num}, fewest=fewest)
    if report.verdict != NONE:
        return _wrong(report)
    missed = [trial.name for trial in scored.missed]
    found, folds = report.detection, scored.scheme == "leave one out"
    # The chi-square that raised no alarm is that of left-out trials too.
    tested = found.level > 0 if folds else np.isfinite(scored.p_value)
    outside = 1 - float(np.mean(scored.after["coverage"]))
    numbers = int(scored.before["count"].to_numpy().sum())
    chance = binom.sf(round(outside * numbers) - 1, numbers, 0.1)
    uncovered = not tested and outside > 1 - covered and chance < level
    if missed or scored.p_value < level or uncovered:
        details = {"trials": missed, "worst": report.worst[0]}
        return decide("WRONG_MODEL", "missed", details, num=num)
    rare = surprising_outcomes(report.residuals, level / len(report.residuals.index))
    if odd := [report.residuals.names[k] for kind in rare for k in kind]:
        decision = "WRONG_MODEL" if len(odd) > 1 else "NOT_ENOUGH_DATA"
        return decide(decision, "outcomes", {"trials": odd}, rare=rare)
    if (alike := report.residuals.alike) <= TOO_SMALL:
        return decide("NOT_ENOUGH_DATA", "alike", {"alike": alike})
    left = found.chi_square / found.degrees_of_freedom
    if found.lower_p_value <= TOO_SMALL and left < hides:
        return decide("NOT_ENOUGH_DATA", "noise", {"residuals": left**0.5})
    if known := report.combinations:
        details = {"combinations": known.to_dict()}
        return decide("NOT_IDENTIFIABLE", "combinations", details, known=known)
    if wide := _hardly_known(report):
        return decide("NOT_ENOUGH_DATA", "parameters", {"parameters": wide})
    p = report.probabilities.get(NONE, 1.0)
    if p < likely:
        other = max(report.probabilities, key=report.probabilities.__getitem__)
        return decide("NOT_ENOUGH_DATA", "likelier", {"effects": [other]}, p=p)
    before, after = scored.rmse
    return decide("SHIP", "ships", {"scored": num, "before": before, "after": after})


def _decided(
    report: Contents,
    decision: str,
    case: str,
    details: dict[str, Any],
    **more: Any,
) -> Gate:
    """Return a decision, its reason in the words of ``gate.jinja``.

    Args:
        report: Report that is decided on.
        decision: The decision.
        case: Case of the template.
        details: Details of the decision.
        **more: Further values that the reason tells.
    """
    given = {"report": report, "case": case, "details": details, **more}
    return Gate(decision, blocks("gate", **given)[0], details)


def _beyond_prior(report: Contents, level: float, *, kept: float = 0.1) -> Gate | None:
    """Return that the prior is too narrow, if a wider one explains the trials.

    Args:
        report: Report with bounds at which parameters are.
        level: Tail probability from which the wider prior explains them.
        kept: Share of a bound that a wider one keeps, where it would change its sign.
    """
    bounds = report.tracing.bounds
    explains = bool(bounds.replaces) or bounds.p_value > level
    found = [p for p in bounds.parameters if p.model == NONE]
    if not (found and explains and report.detection.alarm):
        return None
    box = dict[str, dict[str, float]]()
    for p in found:
        wider = p.bound + 2 * (p.beyond - p.bound)  # as much again beyond the fit
        wider = wider if wider * p.bound >= 0 else kept * p.bound
        box.setdefault(p.name, {})[p.side] = wider
    details = {"bounds": [*map(asdict, found)], "box": box}
    return _decided(report, "OUT_OF_PRIOR", "bounds", details)


def _wrong(report: Contents) -> Gate:
    """Return that effects do not lower the error, or that something is missing."""
    tracing, effects = report.tracing, [*report.tracing.chosen]
    assert report.evaluation is not None
    before, after = tracing.refuted or report.evaluation.rmse
    details = {"effects": effects, "before": before, "after": after}
    if tracing.refuted or (effects and not after < before):
        return _decided(report, "NO_IMPROVEMENT", "no lower", details)
    details |= {"or": tracing.same if effects else [], "worst": report.worst[0]}
    case = "named" if effects and not tracing.beside else "missing"
    return _decided(report, "WRONG_MODEL", case, details)


def _hardly_known(report: Contents, *, limit: float = 0.5) -> list[str]:
    """Return the parameters whose posteriors are half as wide as the prior or more."""
    evidence = report.tracing.evidences[NONE]
    prior = report.prior_draws("gate")
    dim = min(prior.shape[1], evidence.draws.shape[1])
    width = evidence.draws[:, :dim].std(0) / prior[:, :dim].std(0)
    return [n for n, w in zip(evidence.names, width, strict=False) if w > limit]
