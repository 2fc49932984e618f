"""The page of a report: its prose by ``report.jinja``, with tables and figures."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.figures import CAPTIONS, METRICS
from sbi_active.criticism.report.summary import (
    NO_PART,
    added,
    label,
    narrow_prior,
    not_told_from,
    rests,
    sizes,
    suspects_in_words,
    verdict_in_words,
)
from sbi_active.criticism.report.tables import shown, small_sets, tables_of
from sbi_active.criticism.report.words import blocks, listed, number, stated
from sbi_active.criticism.results import FEW_DRAWS, NONE, ModelKey
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.display.page import Page, Picture, Section
from sbi_active.messages import Message, place


def page(report: Contents) -> Page:
    """Return a report as a page, the verdict its title."""
    line, *paragraph = head(report)
    tables, pictures, sections = tables_of(report), _pictures(report), []
    for block in _prose(report)[len(paragraph) + 1 :]:
        if block.startswith("## "):
            title = block.removeprefix("## ")
            text, items = list[str](), list[str]()
            table, picture = tables.get(title), pictures.get(title)
            warns = title == "Warnings"
            sections.append(Section(title, text, items, table, picture, warns))
        elif block.startswith("- "):
            items.append(block.removeprefix("- "))
        else:
            text.append(block)
    return Page(line, sections, [" ".join(paragraph)])


def head(report: Contents) -> list[str]:
    """Return the verdict with what limits it, in a line, and four sentences.

    These are what is missing, the error before and after, what is left, what next.
    """
    return _prose(report, sections=False)


def cautions_with_codes(report: Contents) -> list[tuple[str, str]]:
    """Return the code and the sentence of each warning, without its place."""
    found = []
    for warning in map(Message, report.warnings):
        code = warning.code
        found.append((code, warning.removesuffix(place(code)) if code else warning))
    return found


def _pictures(report: Contents) -> dict[str, Picture]:
    """Return the places of the figures by the titles of their sections."""
    names = {"Residuals": "residuals"}
    if report.has_probabilities:
        names["Effects"] = "probabilities"
    if report.evaluation is not None:
        names["Error before and after"] = "before_after"
    return {t: Picture(n, CAPTIONS[n], CAPTIONS[n]) for t, n in names.items()}


def _prose(report: Contents, *, sections: bool = True) -> list[str]:
    """Return first line, sentences, and sections: titles, paragraphs and items."""
    tracing, misfit, plan = report.tracing, report.tracing.misfit, report.next_action
    evaluation, table = report.evaluation, report.residuals_by_trial
    folds = evaluation is not None and evaluation.scheme != "held out"
    withdrawn = folds and (tracing.refuted or tracing.bounds.replaces)
    helpful = ""
    if misfit is not None:
        refuted = tracing.instead_of if tracing.refuted else ""
        helpful = str(ModelKey(misfit.helps)) if misfit.helps else refuted
    models = [tracing.evidences.get(n) for n in (NONE, tracing.model)]
    gain = np.zeros(1) if plan is None else plan.information_gain
    values: dict[str, Any] = {
        "verdict": verdict_in_words(report),
        "likelier": _likelier(report),
        "rests": rests(tracing) if tracing.needed else "",
        "needs_none": report.verdict != NONE
        and tracing.bounds.p_value > LEVEL
        and not tracing.bounds.replaces,
        "narrow_prior": narrow_prior(tracing),
        "same": not_told_from(tracing, tracing.chosen or [report.verdict]),
        "described": _described(report),
        "suspects": suspects_in_words(tracing),
        "added": added(report),
        "sizes": partial(sizes, report),
        "not_excluded": [
            f"{label(tracing, name)} ({stated(report.probabilities[name])})"
            for name in report.credible_set
            if name != report.verdict and not tracing.instead_of
        ],
        "no_part": NO_PART,
        "helpful": misfit and helpful and misfit.of(helpful),
        "bare": misfit and misfit.of(NONE),
        "scored": tracing.instead_of if withdrawn else added(report),
        "rmse": report.before_after.set_index("metric").to_dict("index").get("rmse"),
        "worst": table.iloc[0].to_dict() if len(table) > 1 else None,
        "cautions": cautions_with_codes(report),
        "left_out": len(small_sets(report)),
        "groups": _groups(report),
        "not_shown": len(table) - len(shown(report)),
        "several": by_channel(report.residuals.x, report.residuals).shape[2] > 1,
        "metrics": METRICS,
        "fewest": FEW_DRAWS,
        "few_draws": any(e and e.effective_sample_size < FEW_DRAWS for e in models),
        "moves": _moves(report),
        "most_told": float(np.nanmax(gain, initial=0.0)),
        **_sizes_left(report),
    }
    return blocks("report", report=report, sections=sections, **values)


def _likelier(report: Contents) -> str:
    """Return the most probable model where the verdict is another; "" else."""
    tracing, p = report.tracing, report.probabilities
    likeliest = max(p, key=p.__getitem__)
    is_another = likeliest not in (report.verdict, tracing.model)
    told = report.verdict == NONE or report.has_probabilities
    return likeliest if is_another and told else ""


def _described(report: Contents) -> str:
    """Return the effects of the verdict, each with its sentence."""
    words = {e.name: " ".join(e.describe.split()) for e in report.tracing.estimates}
    words = {name: f" ({said.rstrip('.')})" for name, said in words.items() if said}
    named = [name + words.get(name, "") for name in report.tracing.chosen]
    return listed(named) or report.verdict


def _sizes_left(report: Contents) -> dict[str, Any]:
    """Return root mean square residuals in units of x, and in deviations."""
    models = [("the bare model", report.residuals)]
    if report.residuals_after is not None:
        models.append((added(report), report.residuals_after))
    misfit, sensor, each = report.tracing.misfit, report.sensor, []
    for name, own in models:
        size = f"{root_mean_square(own.refitted):.2f}"
        if misfit is not None:
            left = by_channel(own.x - own.mean, own)
            size = number(float(root_mean_square(left / misfit.sensor)))
            size += f" ({sizes(report, root_mean_square(left, (0, 1)))})"
        each.append(f"{size} with {name}")
    found = models[-1][1]
    left = by_channel(found.x - found.mean, found)
    own, in_sensors = root_mean_square(left, (0, 1)), ""
    if sensor is not None and sensor.shape in ((1,), own.shape):
        own = own if len(sensor) > 1 else root_mean_square(left)[None]
        in_sensors = ", ".join(f"{size:.2g}" for size in own / sensor)
    return {
        "each_size": each,
        "left_in_units": own,
        "left_in_sensors": in_sensors,
        "left_in_predictions": root_mean_square(found.refitted),
    }


def _groups(report: Contents) -> list[tuple[frozenset[str], str]]:
    """Return the groups of models that nothing separates, or not these trials."""
    tracing = report.tracing
    near = [group for group in tracing.near if group not in tracing.equivalent]
    like = [frozenset.union(*tracing.aliases)] if tracing.aliases else []
    why = {
        "no permitted action separates them": tracing.equivalent,
        "not separated by these trials; another action may": near,
        "nearly the same here, apart by less than the noise; repeated trials may "
        "separate them": like,
    }
    return [(group, said) for said, groups in why.items() for group in groups]


def _moves(report: Contents) -> list[str]:
    """Return the moves of parameters from the bare fit, the farthest first."""
    table: Any = report.parameters.dropna(subset=["before", "after"])
    shift = table["after"] - table["before"]
    far = shift.abs() / table["before_sd"].clip(lower=np.finfo(float).tiny)
    table = table.assign(shift=shift, far=far)[far >= 1]
    table = table.sort_values("far", ascending=False, kind="stable")
    return [
        f"{row['parameter']} by {row['shift']:+.3g} to {number(row['after'])} "
        f"({_times(row['far'])} of its standard deviations)"
        for row in table.to_dict("records")
    ]


def _times(ratio: float) -> str:
    return "more than 1000" if ratio > 1_000 else f"{ratio:.2g}"
