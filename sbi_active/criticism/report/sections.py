"""The page of a report: its prose by ``report.jinja``, with tables and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from math import inf, isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from sbi_active.criticism.contradictions import Misfit
from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.words import (
    NO_PART,
    added,
    blocks,
    label,
    listed,
    narrow_prior,
    not_told_from,
    number,
    probability,
    rests,
    sizes,
    stated,
    suspects_in_words,
    verdict_in_words,
)
from sbi_active.criticism.results import NONE, ModelKey
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.panels import plot_residuals, plot_scores
from sbi_active.display.table import Table
from sbi_active.messages import Message, place
from sbi_active.plain import with_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRICS = {
    "rmse": "RMSE",
    "energy score": "energy score",
    "log predictive density": "log predictive density [nats]",
    "coverage": "share inside the central 90 %",
}
CAPTIONS = {
    "residuals": "Residuals of the models refitted to all trials, in standard "
    "deviations of the prediction; the band is two of them. Each row has its scale, "
    "logarithmic beyond the band where residuals are large.",
    "before_after": "One line a scored trial; the bars are over all of them. Lower is "
    "better for the first two, higher for the third; the dotted line is 90 %.",
}


def figures(report: Contents) -> dict[str, Figure]:
    """Return the report's figures by name."""
    rows, scored = {"bare model": report.residuals}, report.evaluation
    if report.residuals_after is not None:
        rows[f"with {added(report)}"] = report.residuals_after
    labels = () if report.action_is_label else report.action_labels
    found = {
        "residuals": plot_residuals(
            rows, action_labels=labels, channel_names=report.channel_names
        )
    }
    if scored is not None:
        total = scored.table.set_index("metric")[["before", "after"]]
        scores = {
            METRICS[name]: (
                np.stack([scored.before[name], scored.after[name]]),
                total.loc[name].to_numpy(),
            )
            for name in METRICS
        }
        rmse, energy, _, coverage = scores
        found["before_after"] = plot_scores(
            scores, errors=(rmse, energy), levels={coverage: 0.9}
        )
    return found


def shown(report: Contents) -> list[dict[str, Any]]:
    """Return the worst trials, six with those that were set aside."""
    most = max(6 - len(report.tracing.set_aside), 0)
    return report.residuals_by_trial.head(most).to_dict("records")


def tables_of(report: Contents) -> dict[str, Table]:
    """Return the tables of the sections by their titles."""
    misfit, scored = report.tracing.misfit, report.evaluation
    found = {"Effects": _effects(report), "Residuals": _by_trial(report)}
    found["Parameters"] = _parameters(report)
    if misfit is not None:
        found["Models that predict"] = _models(report, misfit)
    if scored is not None:
        header = ["metric", "before", "after", "ratio or difference", "90 % interval"]
        found["Error before and after"] = Table(header, [*_errors(report)])
    header = ["trial", "predicted (90 %)", "measured", "prediction", "verdict before"]
    found["Predicted, then measured"] = Table([*header, "after"], [*_tested(report)])
    return found


def small_sets(report: Contents) -> list[str]:
    """Return the sets of effects that have no share."""
    tracing = report.tracing
    return [
        name
        for name, p in tracing.probabilities.items()
        if tracing.has_several(name) and p < 0.01 and name != tracing.model
    ]


def _models(report: Contents, misfit: Misfit) -> Table:
    """Return the admitted models with their errors."""
    header = ["model", "share", f"left-out {misfit.left_out}", "excess that remains"]
    rows = [
        [
            m.name,
            probability(m.probability) if m.probability > 0 else "not admitted",
            sizes(report, m.left_out),
            f"{100 * m.remains:.0f} %",
            *([] if m.held_out is None else [sizes(report, m.held_out)]),
        ]
        for m in misfit.models
    ]
    has_held_out = any(m.held_out is not None for m in misfit.models)
    return Table(header + ["held-out trials"] * has_held_out, rows)


def _errors(report: Contents) -> Iterator[Sequence[str]]:
    for name, *values, interval in report.before_after.to_numpy():
        ends = "" if interval is None else " to ".join(map(number, interval))
        yield METRICS[name], *map(number, values), ends


def _parameters(report: Contents) -> Table:
    """Return parameters of the bare model, and of the verdict's where it has more."""
    tracing, num = report.tracing, 1 + (report.verdict != NONE)
    units = {e.name: f" [{e.units}]" for e in tracing.estimates if e.units}
    rows = []
    for name, *values in report.parameters.to_numpy():
        each = map(with_error, values[::2], values[1::2])
        rows.append((name + units.get(name, ""), *[*each][:num]))
    header = ["parameter", "bare model", f"with {added(report)}"]
    return Table(header[: 1 + num], rows)


def _tested(report: Contents) -> Iterator[Sequence[str]]:
    for trial in report.tested:
        own = trial.registered
        held = "held" if trial.held else f"failed, {trial.distance:.2g} deviations"
        held = held if trial.is_measured else "no measurement"
        name = f"{own.index:g}: {report.setting(own.action)}"
        yield name, *trial.in_words(), held, own.verdict, trial.after


def _effects(report: Contents) -> Table:
    """Return every model alone, and the sets of effects that have a share.

    Where trials that had no part in it speak against the most probable model, or every
    model misses, probabilities by the fitted trials alone would contradict the verdict:
    they are left out.
    """
    tracing, has_p = report.tracing, report.has_probabilities
    has_sets = has_p and any(map(tracing.has_several, tracing.probabilities))
    estimates = {e.name: e for e in tracing.estimates}
    null, small = tracing.evidences[NONE].log_evidence, small_sets(report)
    rows = []
    for name in (name for name in tracing.probabilities if name not in small):
        p, e = tracing.probabilities[name], estimates.get(name)
        evidence, phi, gain, factor = tracing.evidences.get(name), "", -inf, ""
        if e is not None:
            phi = f"{', '.join(map(with_error, e.mean, e.sd))} {e.units}".strip()
        if evidence is not None:
            gain = evidence.log_evidence - null
            factor = f"{round(gain, 1) + 0.0:.1f}"
        any_set = probability(tracing.inclusion.get(name, p)) if e else ""
        inside = "yes" if name in tracing.credible_set else ""
        cells = [label(tracing, name), *[probability(p)] * has_p, *[any_set] * has_sets]
        cells += [phi, factor, *[inside] * has_p]
        rows.append((-p if has_p else 0.0, -gain, cells))
    rows.sort(key=lambda row: row[:2])
    header = ["model", *["P"] * has_p, *["P in any set"] * has_sets, "phi", "log BF"]
    return Table([*header, *["90 % set"] * has_p], [cells for *_, cells in rows])


def _by_trial(report: Contents) -> Table:
    """Return the root mean square residual of the worst trials, and where it is."""
    found = report.residuals_after or report.residuals
    channels = report.channels(by_channel(found.x, found).shape[2])
    rows = [
        (trial.name, "", number(trial.size), "set aside: on the fit to the others")
        for trial in report.tracing.set_aside
    ]
    for one in shown(report):
        name, unit = channels[one["channel"]]
        where = [name] * (len(channels) > 1)
        where += [] if isnan(one["time"]) else [f"t = {number(one['time'])} s"]
        size = f"{number(one['size'])} {unit}".rstrip()
        rows.append((one["trial"], size, number(one["deviations"]), ", ".join(where)))
    of = "the prediction" if report.tracing.misfit is None else "the sensor"
    return Table(["trial", "in units of x", f"in deviations of {of}", "largest"], rows)


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
    like = [frozenset.union(*tracing.aliases)] if tracing.aliases else []
    why = {
        "no permitted action separates them": tracing.equivalent,
        "nearly the same here, apart by less than the noise; another action or "
        "repeated trials may separate them": like,
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
