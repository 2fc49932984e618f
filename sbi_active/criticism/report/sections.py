"""Sections of a report, and those on the next action and on the record."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbi_active.criticism.data.units import split
from sbi_active.criticism.report import errors, models
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.predicted import predicted_section
from sbi_active.criticism.report.summary import first_paragraph, verdict_line
from sbi_active.criticism.report.words import TOLD, listed, number, probability
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED, NextAction
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.display.page import Page, Section
from sbi_active.messages import Message, place

SEVERE = (
    "The free residual is the bare model and a smooth function of the action, both as "
    "fitted to the trials; the difference is the root mean square over x, in standard "
    "deviations of the verdict's prediction, noise included."
)


def page(report: Contents) -> Page:
    """Return a report as a page, the verdict its title."""
    return Page(verdict_line(report), [*_sections(report)], [first_paragraph(report)])


def cautions_with_codes(report: Contents) -> list[tuple[str, str]]:
    """Return the code and the sentence of each warning, without its place."""
    found = []
    for warning in map(Message, report.warnings):
        code = warning.code
        found.append((code, warning.removesuffix(place(code)) if code else warning))
    return found


def _sections(report: Contents) -> Iterator[Section]:
    if report.warnings:
        items = [f"{c} {said}".strip() for c, said in cautions_with_codes(report)]
        yield Section("Warnings", items=items, warns=True)
    if report.tracing.misfit is not None:
        yield models.admitted_models(report, report.tracing.misfit)
    yield models.effects(report)
    yield models.equivalences(report)
    yield errors.residuals(report)
    yield errors.by_trial(report)
    yield errors.before_and_after(report)
    yield models.parameters(report)
    if report.tested:
        settings = [report.setting(t.registered.action) for t in report.tested]
        yield predicted_section(report.tested, settings, report.stopped)
    yield next_action(report)
    yield _record(report)


def next_action(report: Contents) -> Section:
    """Return the action that tells most, and what no permitted action tells."""
    chosen, title, misfit = report.next_action, "Next action", report.tracing.misfit
    tests = [*_tests(report)]
    tried = [_tried(report)] if report.tracing.chosen else []
    if chosen is None:
        none = "None was asked for: there is no set of permitted actions."
        return Section(title, [none, *tried], items=tests)
    text = [_told(report, chosen)]
    if misfit is not None and len(chosen.separates) > 1:
        text.append(_by_error(misfit))
    text += [*tried, *[SEVERE] * bool(tests)]
    items = (*_by_range(report, chosen), *_inseparable(report, chosen), *tests)
    return Section(title, text, items=items)


def _told(report: Contents, chosen: NextAction) -> str:
    """Return the action, or the reason not to choose one."""
    best = float(np.nanmax(chosen.information_gain, initial=0.0))
    if chosen.action is not None:
        between = f" between {', '.join(chosen.separates)}" * bool(chosen.separates)
        action = report.setting(chosen.action)
        return f"{action}: at least {best:.2f} nats{between} (a lower bound)."
    misfit, one = report.tracing.misfit, chosen.separates[:1]
    found = (
        "no permitted action tells more about which declared model is right than "
        f"{max(best, 0.001):.3f} nats."
    )
    if len(chosen.separates) == 1:
        how = f"predicts left-out {misfit.left_out} so well" if misfit else "is left"
        found = f"of the declared models only {one[0]} {how}."
    if report.verdict == NONE:
        return f"Stop: {found}"
    rest = {
        UNEXPLAINED: " Declare what else the simulator may lack.",
        SCATTER: " Repeat an action to see how large it is.",
    }
    return found[0].upper() + found[1:] + rest.get(report.verdict, "")


def _by_error(misfit: Misfit) -> str:
    """Return the weights of rivals where all of them are wrong."""
    shares = ", ".join(f"{n} {probability(w)}" for n, w in misfit.weights.items())
    return (
        "Every model misses, so that probabilities among them are too sure. Here they "
        f"count by their errors on left-out {misfit.left_out}: {shares}; what each "
        "leaves is a part of its prediction. What nobody declared is not among them, "
        "and the outcome may agree with none."
    )


def _tried(report: Contents) -> str:
    """Return the actions that were executed."""
    if report.action_is_label:
        return "No other inputs were tried than those of these trials."
    action = np.unique(report.residuals.action, axis=0)
    if len(action) == 1:
        return f"No other action was tried than {report.setting(action[0])}."
    entries = [*zip(map(split, report.action_labels), action.T, strict=True)]
    ranges = [
        f"{name} from {column.min():.4g} to {column.max():.4g} {unit}".rstrip()
        for (name, unit), column in entries[: TOLD.entries]
    ]
    rest = len(entries) - len(ranges)
    tried = ", ".join(ranges) + (f", and {rest} more entries" if rest else "")
    return f"No other action was tried than these {len(action)}: {tried}."


def _by_range(report: Contents, chosen: NextAction) -> Iterator[str]:
    """Yield actions that separate forms of a force, in the tried range and beyond."""
    for where, action, gain in (
        ("within the range tried", chosen.within, chosen.within_gain),
        ("beyond the range tried", chosen.beyond, chosen.beyond_gain),
    ):
        if action is not None:
            told = f"at least {gain:.2f} nats between {', '.join(chosen.separates)}"
            yield f"{where}, {report.setting(action)}: {told}"


def _inseparable(report: Contents, chosen: NextAction) -> Iterator[str]:
    """Yield each group that no permitted action separates, and what would."""
    beyond = None if chosen.outside is None else frozenset(chosen.outside_separates)
    groups = [*chosen.inseparable, *([] if beyond is None else [beyond])]
    for group in dict.fromkeys(groups):
        told = f"no permitted action separates {listed(sorted(group))}"
        if group == beyond and chosen.outside is not None:
            told += (
                f"; {report.setting(chosen.outside)}, which is not permitted, would: "
                f"at least {chosen.outside_gain:.2f} nats"
            )
        yield told


def _tests(report: Contents) -> Iterator[str]:
    """Yield each severe test, with how far a free residual's prediction is there."""
    for test, where in zip(report.severe_tests, report.tests, strict=True):
        yield (
            f"the verdict is put to the test most {where}, where its prediction and "
            f"that of a free residual differ by {number(test.difference)} of its "
            "standard deviations"
        )


def _record(report: Contents) -> Section:
    evidences = report.tracing.evidences
    moved = sorted(name for name, e in evidences.items() if e.engine == "smc")
    linear = [name for name, e in evidences.items() if e.engine == "linear"]
    told = [f"the comparison cost {report.num_simulations:,} simulated trials"]
    if linear:
        process = " with a residual process in each" if report.tracing.misfit else ""
        told.append(f"evidence by linearized models{process}")
    if len(moved) + len(linear) < len(evidences):
        told.append("evidence by least squares and importance sampling")
    if moved:
        why = "evidence by sequential Monte Carlo, where that did not serve"
        told.append(f"{why}: {', '.join(moved)}")
    if report.digest:
        declared = "hash of noise, effects and priors, declared before the data"
        told.append(f"{declared}: {report.digest}")
    return Section("Record", items=told)
