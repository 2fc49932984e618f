"""Section of a report if every model misses by more than the sensor's error."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.names import joined, named_entries
from sbi_active.criticism.report.numbers import number, probability, stated
from sbi_active.criticism.results import Array, ModelKey
from sbi_active.criticism.under_misfit import UNDECLARED, Misfit
from sbi_active.display.page import Section
from sbi_active.display.table import Table


def misfit_line(verdict: str, misfit: Misfit) -> str:
    """Return the verdict in one line: what is named, what helps, or nothing."""
    named = misfit.named
    if not misfit.helps:
        return (
            "Verdict: unexplained: the model misses the trials, and no declared effect "
            "helps"
        )
    if not named:
        return (
            f"Verdict: unexplained: {ModelKey(misfit.helps)} predicts better, and is "
            "not named as the cause"
        )
    causes = joined([f"{n} ({stated(misfit.cause[n])})" for n in named])
    line = f"Verdict: {verdict}, probably the cause"
    line += f" ({stated(misfit.cause[named[0]])})" if len(named) == 1 else f": {causes}"
    # An effect that imitates one that was not declared leaves something of it.
    line += "" if misfit.passes else f", beside {UNDECLARED}"
    rest = [n for n in misfit.helps if n not in named]
    verb = "helps" if len(rest) == 1 else "help"
    return line + (f"; {joined(rest)} {verb} to predict" if rest else "")


def misfit_sentences(report: Contents, misfit: Misfit) -> str:
    """Return the findings, the remaining error, and its meaning."""
    begin = f"The bare model misses the {report.num_trials} trials by more than the "
    begin += f"sensor's error of {_size(report, misfit.sensor)}"
    if not misfit.helps:
        own = misfit.of("none")
        return (
            f"{begin}: {_size(report, own.left_out)} on left-out {misfit.left_out}. "
            "No declared effect helps to predict them."
            f"{_withdrawn(report, misfit)}{_guessed(report)}"
        )
    bare, model = misfit.of("none"), misfit.of(str(ModelKey(misfit.helps)))
    change = f"{_change(report, bare.left_out, model.left_out)}"
    remains = f"{100 * model.remains:.0f} % of the excess"
    found = [f"{begin}."]
    named = [*misfit.named]
    if named:
        found += [
            f"{n[0].upper()}{n[1:]}: probably the cause ({_share(misfit, n)})."
            for n in named
        ]
    found += _described(report, misfit.helps)
    verb = "Adding" if not named else "With"
    beside = f", of {UNDECLARED} that it may imitate" * (not misfit.passes)
    found.append(
        f"{verb} {ModelKey(misfit.helps)} the error on left-out {misfit.left_out} goes "
        f"from {change}; {remains} over the sensor's remains{beside}."
    )
    rest = [n for n in misfit.helps if n not in named]
    if rest:
        shares = ", ".join(f"{n} {_share(misfit, n)}" for n in rest)
        found.append(
            f"Probability of being the cause: {shares}; else something undeclared. Use "
            "it to predict inside the tried range, and do not read phi as physics."
        )
    found += [
        f"In place of {n}, {_either(others)} may be there: left-out {misfit.left_out} "
        "are not surely predicted worse with it."
        for n, others in misfit.instead.items()
    ]
    if model.held_out is not None and bare.held_out is not None:
        change = _change(report, bare.held_out, model.held_out)
        found.append(f"On held-out trials: {change}.")
    return " ".join(found)


def _withdrawn(report: Contents, misfit: Misfit) -> str:
    """Return the errors with effects that are not named since these do not fall."""
    name = report.tracing.instead_of
    if not (name and report.tracing.refuted):
        return ""
    bare, own = misfit.of("none"), misfit.of(name)
    left = _change(report, bare.left_out, own.left_out)
    said = f" With {name} the error on left-out {misfit.left_out} goes from {left}"
    if own.held_out is not None and bare.held_out is not None:
        held = _change(report, bare.held_out, own.held_out)
        said += f", on held-out trials from {held}"
    return f"{said}."


def _either(names: Sequence[str]) -> str:
    """Return names as in "a, b or c"."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def _described(report: Contents, names: Sequence[str]) -> list[str]:
    """Return on what each effect depends, a sentence each."""
    return [
        f"{e.name}: {e.describe.rstrip('.')}."
        for name in names
        for e in report.tracing.estimates
        if e.name == name and e.describe
    ]


def _guessed(report: Contents) -> str:
    if report.guess is None:
        return ""
    return (
        f" What it leaves follows {report.guess}, with x the output, x' its slope, xi "
        "the action and t the time in the trial: a guess, not declared. Declare what "
        "it suggests."
    )


def admitted_models(report: Contents, misfit: Misfit) -> Section:
    """Return the error of every admitted model on trials it was not fitted to."""
    has_held = any(m.held_out is not None for m in misfit.models)
    header = ["model", "P", f"left-out {misfit.left_out}", "excess that remains"]
    header += ["held-out trials"] * has_held
    rows = []
    for m in misfit.models:
        cells = [
            m.name,
            probability(m.probability) if m.probability > 0 else "not admitted",
            _size(report, m.left_out),
            f"{100 * m.remains:.0f} %",
        ]
        held = [] if m.held_out is None else [_size(report, m.held_out)]
        rows.append((*cells, *held))
    if isnan(misfit.time_scale):  # x has no time axis
        error = "an error of unknown size in each number, beside the sensor's"
        name, scale, near = "that error", "", "fifth"
    else:
        error = "a residual process of unknown size and time scale"
        name, scale = "the process", f" and a time scale of {number(misfit.time_scale)}"
        near = "tenth"
    if misfit.left_out == "trials":  # fewer of them do not tell
        error += ", or a parameter that differs from trial to trial"
    model = report.tracing.instead_of or "the verdict's model"
    text = [
        f"Every model carries {error}, so "
        "that P is one evidence for alarm and verdict. Admitted are the models whose "
        f"error on left-out {misfit.left_out}, in units of what the others let expect, "
        f"is within a {near} of the smallest, and what is more probable than these by "
        "ten nats; P is among them. Errors below are root "
        "mean squares of models fitted without what they predict. The "
        f"sensor's error is {_size(report, misfit.sensor)}; the excess is what is "
        "beyond it, as a share of the bare model's.",
        f"Beside {model} {name} has {misfit.size:.2g} times the "
        f"sensor's standard deviation{scale}.",
    ]
    items = [
        f"{n}: probability of the cause {_share(misfit, n)}, of a better prediction of "
        f"a new trial {probability(misfit.better[n])}; the verdict gains "
        f"{misfit.odds[n].gained:.0f} nats by it, and {100 * misfit.remains[n]:.0f} % "
        "of the excess of the fit without it remains" + _outdone(misfit.odds[n].guessed)
        for n in misfit.helps
    ]
    return Section(
        "Models that predict",
        tuple(text),
        items=tuple(items),
        table=Table(header, rows),
    )


def _outdone(nats: float) -> str:
    """Return the gain of elementary formulas over an effect, if any."""
    return f"; guesses in its place gain {nats:.0f} nats over it" if nats > 1 else ""


def _share(misfit: Misfit, name: str) -> str:
    return probability(misfit.cause[name])


def _change(report: Contents, before: Array, after: Array) -> str:
    """Return two errors by channel, as in "154 to 52.1 N"."""
    parts = [
        f"{name}{number(float(a))} to {number(float(b))}{unit}"
        for (name, unit), a, b in zip(
            _channels(report, len(before)), before, after, strict=True
        )
    ]
    return joined(parts)


def _size(report: Contents, values: Array) -> str:
    """Return errors by channel with their units."""
    channels = _channels(report, len(values))
    return joined(
        [
            f"{name}{number(float(v))}{unit}"
            for (name, unit), v in zip(channels, values, strict=True)
        ]
    )


def _channels(report: Contents, num: int) -> Sequence[tuple[str, str]]:
    """Return the name of each channel, where there are several, and its unit."""
    labels = report.channel_names or ()
    if len(labels) != num:
        labels = [f"channel {i + 1}" for i in range(num)]
    pairs = named_entries(tuple(labels))
    return [
        (f"{name} " if num > 1 else "", f" {unit}" if unit else "")
        for name, unit in pairs
    ]
