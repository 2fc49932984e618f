"""What a report says, apart from how it is set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sbi_active.criticism.figures import METRICS
from sbi_active.criticism.headline import added, number, probability
from sbi_active.criticism.results import (
    NONE,
    Array,
    Evaluation,
)

if TYPE_CHECKING:
    from sbi_active.criticism.report import Report

__all__ = ["Section", "sections"]

SHOWN = 0.01  # probability from which a set of several effects stands in the table
FEW_PAIRS = 8  # scored trials below which the pairs stand in place of an interval


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes:
        title: Its heading.
        text: Paragraphs.
        items: A list of points.
        header: Of the table.
        rows: Of the table, cells as text.
        figure: Name of the figure.
    """

    title: str
    text: tuple[str, ...] = ()
    items: tuple[str, ...] = ()
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figure: str | None = None


def sections(report: Report) -> Iterator[Section]:
    """Yield the parts of a report in order."""
    if report.warnings:
        yield Section("Warnings", items=report.warnings)
    yield _effects(report)
    yield _equivalences(report)
    yield _residuals(report)
    yield _errors(report)
    yield _parameters(report)
    yield _next(report)
    yield _record(report)


def _effects(report: Report) -> Section:
    """Return every model alone, and the sets of effects that have a share."""
    tracing = report.tracing
    any_set = any(" + " in name for name in tracing.probabilities)
    shares = ("P in any set",) if any_set else ()
    header = ("model", "P", *shares, "phi", "log BF", "ESS", "engine", "90 % set")
    estimates = {e.name: e for e in tracing.estimates}
    null = tracing.evidences[NONE].log_evidence
    rows, left_out = [], 0
    for name, p in tracing.probabilities.items():
        if " + " in name and p < SHOWN and name != tracing.verdict:
            left_out += 1
            continue
        inclusion, phi, fit = ("",) * any_set, "", ("", "", "")
        if name in estimates:
            e = estimates[name]
            pairs = zip(e.mean, e.sd, strict=True)
            phi = ", ".join(_with_error(m, sd) for m, sd in pairs) + f" {e.units}"
            share = probability(tracing.inclusion.get(name, p))
            inclusion = (share,) * any_set
        if name in tracing.evidences:
            found = tracing.evidences[name]
            fit = (
                f"{found.log_evidence - null:.1f}",
                f"{found.effective_sample_size:.0f}",
                found.engine,
            )
        inside = "yes" if name in tracing.credible_set else ""
        cells = (name, probability(p), *inclusion, phi.strip(), *fit, inside)
        rows.append((p, cells))
    rows.sort(key=lambda row: -row[0])
    text = [
        "P: probability of the model given the trials. phi: strength of the effect "
        "if it alone is added. log BF: log Bayes factor against the bare model, nats. "
        "ESS: effective samples behind it. 90 % set: the smallest set of models that "
        "holds 90 % of the probability."
    ]
    if left_out:
        text.append(
            f"{left_out} sets of several effects have P < {SHOWN:g} each and are left "
            "out."
        )
    if report.guess is not None:
        text.append(
            f"A guess, not declared: {report.guess}, "
            f"{tracing.guesses[0][1]:.1f} nats above the residual process."
        )
    return Section(
        "Effects",
        tuple(text),
        header=header,
        rows=tuple(cells for _, cells in rows),
        figure="probabilities",
    )


def _equivalences(report: Report) -> Section:
    tracing = report.tracing
    items = [
        f"{_joined(group)}: no permitted action separates them"
        for group in tracing.equivalent
    ]
    items += [
        f"{_joined(group)}: not separated by these trials; another action may"
        for group in tracing.near
        if group not in tracing.equivalent
    ]
    by = "these trials" if report.next_action is None else "a permitted action"
    text = () if items else (f"Every pair of models is separated by {by}.",)
    return Section("Equivalence sets", text=text, items=tuple(items))


def _residuals(report: Report) -> Section:
    def describe(z: np.ndarray) -> str:
        z = z[np.isfinite(z)]
        size = np.sqrt((z**2).mean()) if z.size else np.nan
        return f"{size:.2f}, {np.mean(np.abs(z) > 2):.0%} beyond 2"

    before = report.residuals
    rows = [
        ("bare model", describe(before.refitted), describe(before.prequential)),
    ]
    if report.residuals_after is not None:
        after = report.residuals_after
        rows.append(
            (
                f"with {added(report)}",
                describe(after.refitted),
                describe(after.prequential),
            )
        )
    detection = report.detection
    noise = {
        "declared": "The noise is declared.",
        "estimated": "The noise is estimated from repeated trials.",
        "stochastic": "The noise is the simulator's own.",
    }[before.noise]
    text = [
        "Observation minus prediction, in standard deviations of the prediction: about "
        "1, and 5 % beyond 2, where the model holds.",
        f"{noise} Chi-square of the bare model "
        f"{detection.chi_square:.1f} on {detection.degrees_of_freedom} degrees of "
        f"freedom, p {_p_value(detection.p_value)}.",
    ]
    if before.times is not None:
        text.append(f"Correlation of neighboring errors {before.correlation:.2f}.")
    header = ("root mean square [sd]", "refitted", "predicted from earlier trials")
    return Section(
        "Residuals", tuple(text), header=header, rows=tuple(rows), figure="residuals"
    )


def _errors(report: Report) -> Section:
    evaluation, title = report.evaluation, "Error before and after"
    if evaluation is None:
        return Section(title, ("No trial was scored.",))
    rows = [
        (
            METRICS.get(str(name), str(name)),
            number(before),
            number(after),
            number(ratio),
            "" if interval is None else " to ".join(map(number, interval)),
        )
        for name, before, after, ratio, interval in report.before_after.itertuples(
            index=False
        )
    ]
    num = len(evaluation.trials)
    if evaluation.scheme == "held out":
        text = [f"{num} held-out trials, which had no part in choosing or fitting."]
    else:
        same = sum(verdict == report.verdict for verdict in evaluation.selected)
        text = [
            f"{num} trials, each predicted by models that were chosen and fitted "
            f"without it ({evaluation.scheme}); {same} of {num} such verdicts are "
            f"{report.verdict}, that of all trials."
        ]
    text.append(
        "The third number is after / before for the RMSE and the energy score, and "
        "after - before for the other two."
    )
    pairs: list[str] = []
    if num < FEW_PAIRS:
        text.append(
            f"Below {FEW_PAIRS} trials an interval over trials covers too little; "
            "these are the pairs:"
        )
        pairs = _pairs(evaluation)
    header = ("metric", "before", "after", "ratio or difference", "90 % interval")
    return Section(
        title,
        tuple(text),
        items=tuple(pairs),
        header=header,
        rows=tuple(rows),
        figure="before_after",
    )


def _pairs(evaluation: Evaluation) -> list[str]:
    """Return the RMSE and the log density of each scored trial, before and after."""
    found = []
    for i, trial in enumerate(evaluation.trials):
        each = [
            f"{METRICS[name]} {number(float(evaluation.before[name][i]))} -> "
            f"{number(float(evaluation.after[name][i]))}"
            for name in ("rmse", "log predictive density")
        ]
        which = "held-out trial" if evaluation.scheme == "held out" else "trial"
        found.append(f"{which} {int(trial)}: {', '.join(each)}")
    return found


def _parameters(report: Report) -> Section:
    header = ["parameter", "bare model", f"with {added(report)}"]
    rows = []
    for name, before, before_sd, after, after_sd in report.parameters.itertuples(
        index=False
    ):
        cells = _with_error(before, before_sd), _with_error(after, after_sd)
        rows.append((str(name), *cells))
    if report.verdict == NONE:
        return Section(
            "Parameters",
            header=(*header[:2],),
            rows=tuple(row[:2] for row in rows),
        )
    return Section("Parameters before and after", header=(*header,), rows=tuple(rows))


def _next(report: Report) -> Section:
    chosen, title = report.next_action, "Next action"
    if chosen is None:
        return Section(
            title, ("None was asked for: there is no set of permitted actions.",)
        )
    best = float(np.nanmax(chosen.information_gain, initial=0.0))
    if chosen.action is None:
        text = [
            "Stop: no permitted action tells more about which model is right than "
            f"{max(best, 0.001):.3f} nats."
        ]
    else:
        question = f" between {_joined(chosen.separates)}" if chosen.separates else ""
        text = [
            f"{_action(report, chosen.action)}: at least {best:.2f} nats{question} (a "
            "lower bound)."
        ]
    if chosen.outside is not None:
        text.append(
            f"Outside the permitted actions, {_action(report, chosen.outside)} would "
            f"tell {_joined(chosen.outside_separates)} apart: at least "
            f"{chosen.outside_gain:.2f} nats."
        )
    return Section(title, tuple(text))


def _action(report: Report, action: Array) -> str:
    pairs = zip(report.action_labels, action, strict=True)
    return ", ".join(f"{label} = {value:.4g}" for label, value in pairs)


def _record(report: Report) -> Section:
    spent = sum(e.num_simulations for e in report.tracing.evidences.values())
    items = [f"evidence cost {spent:,} simulated trials"]
    if report.digest:
        items.append(f"frozen before the data: {report.digest}")
    tempered = sorted(
        name for name, e in report.tracing.evidences.items() if e.engine == "tempering"
    )
    if tempered:
        items.append(
            f"evidence by tempering, where least squares and importance sampling did "
            f"not serve: {', '.join(tempered)}"
        )
    if report.detection.null_cross_check is not None:
        items.append(
            f"log evidence of the bare model {report.detection.null_log_evidence:.2f}, "
            f"by tempering {report.detection.null_cross_check:.2f}"
        )
    return Section("Record", items=tuple(items))


def _joined(names: Sequence[str] | frozenset[str]) -> str:
    return (
        " = ".join(sorted(names)) if isinstance(names, frozenset) else ", ".join(names)
    )


def _with_error(mean: float, sd: float) -> str:
    return "" if np.isnan(mean) else f"{mean:.4g} +- {sd:.2g}"


def _p_value(value: float) -> str:
    return f"= {value:.2g}" if value > 1e-99 else "< 1e-99"
