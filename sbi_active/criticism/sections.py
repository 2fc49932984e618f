"""What a report says, apart from how it is set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sbi_active.criticism.figures import METRICS
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED

if TYPE_CHECKING:
    from sbi_active.criticism.report import Report

__all__ = ["Section", "sections", "summary_sentence", "verdict_line"]

SHOWN = 0.01  # probability from which a set of several effects stands in the table


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


def verdict_line(report: Report) -> str:
    """Return the verdict with what limits it, in one line."""
    tracing, verdict = report.tracing, report.verdict
    probability = tracing.probabilities.get(verdict)
    stated = "" if probability is None else f" (P = {_probability(probability)})"
    line = f"Verdict: {verdict}{stated}"
    if report.guess is not None:
        line += f", a guess, not declared: {report.guess}"
    if not tracing.robust:
        line += ", not robust to its prior"
    named = {*tracing.chosen} or {verdict}
    groups = [group for group in tracing.equivalent if group & named]
    same = sorted(frozenset().union(*groups) - named)
    if same:
        line += f"; no permitted action tells it from {', '.join(same)}"
    return line


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


def summary_sentence(report: Report) -> str:
    """Return what the verdict says, in a sentence or two."""
    detection, trials = report.detection, f"{report.num_trials} trials"
    against = (
        f"log Bayes factor {detection.log_bayes_factor:.1f} +- "
        f"{detection.standard_error:.1f} nats against the bare model; an alarm needs "
        f"{detection.threshold:.1f} at the lower end, {detection.lower:.1f}"
    )
    if report.verdict == NONE:
        return f"The bare model explains the {trials} ({against})."
    if report.verdict == UNEXPLAINED:
        return (
            f"The bare model misses the {trials} ({against}), and so does every "
            "declared effect."
        )
    if report.verdict == SCATTER:
        return (
            f"The {trials} scatter more than declared ({against}), and no effect "
            "explains it."
        )
    sentences = [
        f"{e.name}: {e.describe}."
        for e in report.tracing.estimates
        if e.name in report.tracing.chosen and e.describe
    ]
    first = f"The bare model misses the {trials} ({against})."
    return " ".join([first, *sentences])


def _effects(report: Report) -> Section:
    """Return every model alone, and the sets of effects that have a share."""
    tracing = report.tracing
    header = ("model", "P", "P in any set", "phi", "log BF", "ESS", "engine", "90 %")
    estimates = {e.name: e for e in tracing.estimates}
    null = tracing.evidences[NONE].log_evidence
    rows, left_out = [], 0
    for name, probability in tracing.probabilities.items():
        if " + " in name and probability < SHOWN and name != tracing.verdict:
            left_out += 1
            continue
        inclusion, phi, fit = "", "", ("", "", "")
        if name in estimates:
            e = estimates[name]
            pairs = zip(e.mean, e.sd, strict=True)
            phi = ", ".join(_with_error(m, sd) for m, sd in pairs) + f" {e.units}"
            inclusion = _probability(tracing.inclusion.get(name, probability))
        if name in tracing.evidences:
            found = tracing.evidences[name]
            fit = (
                f"{found.log_evidence - null:.1f}",
                f"{found.effective_sample_size:.0f}",
                found.engine,
            )
        inside = "yes" if name in tracing.credible_set else ""
        cells = (name, _probability(probability), inclusion, phi.strip(), *fit, inside)
        rows.append((probability, cells))
    rows.sort(key=lambda row: -row[0])
    text = [
        "phi is that of the effect alone; log BF against the bare model, in nats; the "
        "last column marks the 90 % credible set."
    ]
    if left_out:
        text.append(
            f"{left_out} sets of several effects have less than {SHOWN:g} each."
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
    text = (
        () if items else ("Every pair of models is separated by a permitted action.",)
    )
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
            ("with the effect", describe(after.refitted), describe(after.prequential))
        )
    detection = report.detection
    text = [
        f"Noise {before.noise}. Chi-square of the bare model "
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
            _number(before),
            _number(after),
            _number(ratio),
            "" if interval is None else " to ".join(map(_number, interval)),
        )
        for name, before, after, ratio, interval in report.before_after.itertuples(
            index=False
        )
    ]
    num = len(evaluation.trials)
    text = [f"{num} trials, {evaluation.scheme}: none had a part in what scores it."]
    if num < 8:
        text.append(
            "Below 8 trials an interval over trials covers too little; the pairs are "
            "in the figure."
        )
    header = (
        "metric",
        "before",
        "after",
        "after / before, or difference",
        "90 % interval",
    )
    return Section(
        title, tuple(text), header=header, rows=tuple(rows), figure="before_after"
    )


def _parameters(report: Report) -> Section:
    rows = []
    for name, before, before_sd, after, after_sd in report.parameters.itertuples(
        index=False
    ):
        cells = _with_error(before, before_sd), _with_error(after, after_sd)
        rows.append((str(name), *cells))
    return Section(
        "Parameters before and after",
        header=("parameter", "bare model", "with the effect"),
        rows=tuple(rows),
    )


def _next(report: Report) -> Section:
    chosen, title = report.next_action, "Next action"
    if chosen is None:
        return Section(
            title, ("None was asked for: there is no set of permitted actions.",)
        )
    best = float(np.nanmax(chosen.information_gain, initial=0.0))
    if chosen.action is None:
        text = (
            "Stop: no permitted action tells more about which model is right than "
            f"{max(best, 0.001):.3f} nats."
        )
        return Section(title, (text,))
    action = ", ".join(
        f"{label} = {value:g}"
        for label, value in zip(report.action_labels, chosen.action, strict=True)
    )
    question = f" between {_joined(chosen.separates)}" if chosen.separates else ""
    return Section(
        title, (f"{action}: at least {best:.2f} nats{question} (a lower bound).",)
    )


def _record(report: Report) -> Section:
    spent = sum(e.num_simulations for e in report.tracing.evidences.values())
    items = [f"evidences cost {spent} trial simulations"]
    if report.digest:
        items.append(f"frozen before the data: {report.digest}")
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


def _probability(value: float) -> str:
    if value < 0.005:
        return "< .01"
    return "> .99" if value > 0.995 else f"{value:.2f}"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3g}"


def _with_error(mean: float, sd: float) -> str:
    return "" if np.isnan(mean) else f"{mean:.4g} +- {sd:.2g}"


def _p_value(value: float) -> str:
    return f"= {value:.2g}" if value > 1e-99 else "< 1e-99"
