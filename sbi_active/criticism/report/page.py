"""The page of a report: its prose by ``report.jinja``, with tables and a figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sbi_active.criticism.data.columns import split
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.words import blocks, cautions, probability
from sbi_active.criticism.results import NONE, Array, Tracing
from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.panels import plot_residuals
from sbi_active.display.table import Table, number
from sbi_active.plain import with_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURE = Picture(
    "residuals",
    "residuals of each trial before and after",
    "Residuals of the models refitted to all trials, in standard deviations of the "
    "prediction; the band is two of them. Each row has its scale, logarithmic beyond "
    "the band where residuals are large.",
)
#: Trials with the largest residuals that are listed.
WORST = 6


def figures(report: Contents) -> dict[str, Figure]:
    """Return the report's figures by name."""
    rows = {"bare model": report.residuals}
    if report.residuals_after is not None:
        rows[f"with {report.tracing.model}"] = report.residuals_after
    labels = () if report.trials.action_is_label else report.action_labels
    names = report.channel_names
    drawn = plot_residuals(rows, action_labels=labels, channel_names=names)
    return {PICTURE.name: drawn}


def page(report: Contents) -> Page:
    """Return a report as a page, the verdict its title."""
    said, sections = prose(report), list[Section]()
    first = next(k for k, block in enumerate(said) if block.startswith("## "))
    worst = report.residuals_by_trial.drop(columns="index").head(WORST)
    header = ["trial", "predicted (90 %)", "measured", "prediction", "verdict", "after"]
    tables = {
        "Models": _models(report),
        "Residuals": Table.of(worst),
        "Error before and after": Table.of(report.before_after),
        "Parameters": _parameters(report),
        "Predicted, then measured": Table(header, [*_tested(report)]),
    }
    for block in said[first:]:
        if block.startswith("## "):
            title = block.removeprefix("## ")
            text, items = list[str](), list[str]()
            picture = PICTURE if title == "Residuals" else None
            warns = title == "Warnings"
            made = Section(title, text, items, tables.get(title), picture, warns)
            sections.append(made)
        elif block.startswith("- "):
            items.append(block.removeprefix("- "))
        else:
            text.append(block)
    return Page(said[0], sections, [" ".join(said[1:first])])


def prose(report: Contents) -> list[str]:
    """Return first line, four sentences, and sections: titles, paragraphs and items.

    The line has the verdict with what limits it; the sentences say what is missing, the
    error before and after, what is left, what next.
    """
    p, plan, tracing = report.probabilities, report.next_action, report.tracing
    gain = [] if plan is None else plan.information_gain
    values = {
        "num_trials": len(report.residuals.index),
        "forms": _forms(tracing),
        "families": sorted({str(tracing.effects[n].family) for n in tracing.chosen}),
        "likeliest": max(p, key=p.__getitem__),
        "left": report.left,
        "rmse": report.before_after.set_index("metric").to_dict("index").get("rmse"),
        "sizes": partial(sizes, report),
        "cautions": cautions(report),
        "listed_trials": WORST,
        "most_told": float(np.nanmax([0.0, *gain])),
    }
    return blocks("report", report=report, **values)


def sizes(report: Contents, *values: Array) -> str:
    """Return a number by channel, or "before to after", with names and units."""
    each = [" to ".join(map(number, of)) for of in zip(*values, strict=True)]
    channels = [*map(split, report.channels(len(each)))]
    return ", ".join(
        f"{f'{name} ' * (len(each) > 1)}{text} {unit}".rstrip()
        for (name, unit), text in zip(channels, each, strict=True)
    )


def _forms(tracing: Tracing) -> dict[str, float]:
    """Return the forms of the forces that are chosen where none has P >= .9."""
    effects, p = tracing.effects, tracing.probabilities
    chosen = [effects[name] for name in tracing.chosen]
    if p.get(tracing.verdict, 0.0) >= 0.9 or not all(map(is_force, chosen)):
        return {}
    own = {
        name: {e.family for n, e in effects.items() if n in name.split(" + ")}
        for name in p
    }
    families = {effect.family for effect in chosen}
    return {name: p[name] for name in p if families and families <= own[name]}


def _models(report: Contents) -> Table:
    """Return every model that has draws, the most probable first.

    Where trials that had no part in it speak against the most probable model,
    probabilities by the fitted trials alone would contradict the verdict: they are left
    out. Where every model misses, they are shares among those that predict.
    """
    tracing, misfit = report.tracing, report.tracing.misfit
    errors = {} if misfit is None else {m.name: m for m in misfit.models}
    has_p = misfit is not None or not tracing.instead_of
    null, rows = tracing.evidences[NONE].log_evidence, []
    for name, p in tracing.probabilities.items():
        if (own := tracing.evidences.get(name)) is None:
            continue
        effect, gain, phi = tracing.effects.get(name), own.log_evidence - null, ""
        if effect is not None:
            each = [with_error(*own.moments[n]) for n in effect.phi_names]
            phi = f"{', '.join(each)} {effect.units}".strip()
        cells = [name, *[probability(p)] * has_p, phi, f"{round(gain, 1) + 0.0:.1f}"]
        if misfit is not None:
            cells.append(sizes(report, errors[name].left_out) if name in errors else "")
        rows.append((-p if has_p else 0.0, -gain, cells))
    header = ["model", *["P" if misfit is None else "share"] * has_p, "phi", "log BF"]
    header += [] if misfit is None else [f"error on left-out {misfit.left_out}"]
    rows.sort(key=lambda row: row[:2])
    return Table(header, [cells for *_, cells in rows])


def _parameters(report: Contents) -> Table:
    """Return the parameters of the bare model and of that of the verdict."""
    units = {n: f" [{e.units}]" for n, e in report.tracing.effects.items() if e.units}
    table = report.parameters
    names = [name + units.get(name, "") for name in table["parameter"]]
    before = map(with_error, table["before"], table["before_sd"])
    after = map(with_error, table["after"], table["after_sd"])
    header = ("parameter", "before", "after")
    return Table(header, [*zip(names, before, after, strict=True)])


def _tested(report: Contents) -> Iterator[Sequence[str]]:
    for trial in report.tested:
        held = "held" if trial.held else f"failed, {trial.distance:.2g} deviations"
        held = held if trial.is_measured else "no measurement"
        name = f"{trial.index:g}: {report.setting(trial.action)}"
        yield name, *trial.in_words(), held, trial.verdict, trial.after
