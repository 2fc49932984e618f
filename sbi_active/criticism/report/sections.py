"""The page of a report: its prose by ``report.jinja``, with tables and figures."""

from __future__ import annotations

import re
from functools import cache
from math import isnan
from typing import Any

import numpy as np

from sbi_active.criticism.data.units import split
from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.figures import METRICS, pictured
from sbi_active.criticism.report.summary import (
    NO_PART,
    added,
    label,
    limits,
    narrow_prior,
    not_told_from,
    sizes,
    suspects_in_words,
    verdict_in_words,
)
from sbi_active.criticism.report.tables import shown, small_sets, tables_of
from sbi_active.criticism.report.words import (
    counted,
    listed,
    number,
    probability,
    stated,
)
from sbi_active.criticism.results import FEW_DRAWS, NONE, ModelKey
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.display.page import Page, Section, environment
from sbi_active.messages import Message, place


def page(report: Contents) -> Page:
    """Return a report as a page, the verdict its title."""
    tables, pictures = tables_of(report), {"Effects": pictured("probabilities")}
    pictures |= {"Residuals": pictured("residuals")}
    pictures |= {"Error before and after": pictured("before_after")}
    if not report.has_probabilities:
        del pictures["Effects"]
    if report.evaluation is None:
        del pictures["Error before and after"]
    sections = []
    head, *parts = _prose(report).split("\n## ")
    for part in parts:
        title, *blocks = _blocks(f"{part}\n")
        items = [block[2:] for block in blocks if block.startswith("- ")]
        text = [block for block in blocks if not block.startswith("- ")]
        table, picture = tables.get(title), pictures.get(title)
        warns = title == "Warnings"
        sections.append(Section(title, text, items, table, picture, warns))
    line, *paragraph = _blocks(head)
    return Page(line, sections, [" ".join(paragraph)])


def sentences(report: Contents) -> tuple[str, str, str, str]:
    """Return what is missing, the error before and after, what is left, what next."""
    _, missing, errors, left, following = _head(report)
    return missing, errors, left, following


def verdict_line(report: Contents) -> str:
    """Return the verdict with what limits it, in one line."""
    return _head(report)[0]


def _head(report: Contents) -> list[str]:
    """Return the first line and the four sentences."""
    return _blocks(_prose(report, sections=False))


def cautions_with_codes(report: Contents) -> list[tuple[str, str]]:
    """Return the code and the sentence of each warning, without its place."""
    found = []
    for warning in map(Message, report.warnings):
        code = warning.code
        found.append((code, warning.removesuffix(place(code)) if code else warning))
    return found


def _blocks(prose: str) -> list[str]:
    """Return paragraphs and items, a line each; a title ends in its own line."""
    return [" ".join(b.split()) for b in re.split(r"\n\s*\n", prose) if b.strip()]


@cache
def _template() -> Any:
    made = environment("sbi_active.criticism", "report")
    for form in (number, probability, stated, listed, counted):
        made.filters[form.__name__] = form
    return made.get_template("report.jinja")


def _prose(report: Contents, *, sections: bool = True) -> str:
    """Return first line, sentences and sections, blank lines between paragraphs."""
    tracing, misfit, plan = report.tracing, report.tracing.misfit, report.next_action
    words = {e.name: " ".join(e.describe.split()) for e in tracing.estimates}
    words = {name: said.rstrip(".") for name, said in words.items() if said}
    named = [f"{n} ({words[n]})" if n in words else n for n in tracing.chosen]
    evaluation, table = report.evaluation, report.residuals_by_trial
    folds = evaluation is not None and evaluation.scheme != "held out"
    withdrawn = folds and (tracing.refuted or tracing.bounds.replaces)
    scores = report.before_after.set_index("metric").to_dict("index")
    helpful = None
    if misfit is not None:
        refuted = tracing.instead_of if tracing.refuted else ""
        name = str(ModelKey(misfit.helps)) if misfit.helps else refuted
        helpful = misfit.of(name) if name else None
    evidences = tracing.evidences
    models = [evidences[n] for n in (NONE, tracing.model) if n in evidences]
    inseparable = [] if plan is None else [*plan.inseparable]
    beyond = frozenset(() if plan is None else plan.outside_separates)
    inseparable += [beyond] if plan is not None and plan.outside is not None else []
    is_misfit = misfit is not None and bool(tracing.chosen)
    others = [
        f"{label(tracing, name)} ({stated(report.probabilities[name])})"
        for name in report.credible_set
        if name != report.verdict and not tracing.instead_of
    ]
    gain = np.zeros(1) if plan is None else plan.information_gain
    likeliest = max(tracing.probabilities, key=tracing.probabilities.__getitem__)
    needs_none = report.verdict != NONE and tracing.bounds.p_value > LEVEL
    values: dict[str, Any] = {
        "verdict": verdict_in_words(report),
        "likelier": likeliest if report.verdict == NONE != likeliest else None,
        "limits": limits(tracing),
        "needs_none": needs_none and not tracing.bounds.replaces,
        "narrow_prior": narrow_prior(tracing),
        "same": not_told_from(tracing, tracing.chosen or [report.verdict]),
        "missed": () if evaluation is None else evaluation.missed,
        "described": listed(named) or report.verdict,
        "suspects": suspects_in_words(tracing),
        "added": added(report),
        "sizes": lambda *values: sizes(report, *values),
        "not_excluded": others,
        "no_part": NO_PART,
        "helpful": helpful,
        "bare": misfit and misfit.of(NONE),
        "scored": tracing.instead_of if withdrawn else added(report),
        "rmse": scores.get("rmse"),
        "worst": table.iloc[0].to_dict() if len(table) > 1 else None,
        "unit": "the prediction" if misfit is None else "the sensor",
        "cautions": cautions_with_codes(report),
        "timed": misfit is not None and not isnan(misfit.time_scale),
        "support": misfit and {n: misfit.support[n] for n in misfit.helps},
        "has_p": report.has_probabilities,
        "left_out": len(small_sets(report)),
        "groups": _groups(report),
        "not_shown": len(table) - len(shown(report)),
        "several": by_channel(report.residuals.x, report.residuals).shape[2] > 1,
        "whole": tracing.model if is_misfit else report.verdict,
        "pairs": _pairs(report),
        "fewest": f"{FEW_DRAWS:.0f}",
        "few_draws": any(e.effective_sample_size < FEW_DRAWS for e in models),
        "moves": _moves(report),
        "most_told": float(np.nanmax(gain, initial=0.0)),
        "tried": _tried(report),
        "inseparable": [*dict.fromkeys(inseparable)],
        "outside_group": beyond,
        "engines": _engines(report),
        **_sizes_left(report),
    }
    return _template().render(report=report, sections=sections, **values)


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
    return [
        *(
            (group, "no permitted action separates them")
            for group in tracing.equivalent
        ),
        *((g, "not separated by these trials; another action may") for g in near),
    ]


def _pairs(report: Contents) -> list[str]:
    """Return the scores of each trial, where they are too few for an interval."""
    evaluation, found = report.evaluation, []
    if evaluation is None or len(evaluation.trials) >= 8:
        return []
    which = "held-out trial" if evaluation.scheme == "held out" else "trial"
    for i, trial in enumerate(evaluation.trials):
        name = evaluation.names[i] if evaluation.names else int(trial)
        each = [
            f"{METRICS[metric]} {number(float(evaluation.before[metric][i]))} -> "
            f"{number(float(evaluation.after[metric][i]))}"
            for metric in ("rmse", "log predictive density")
        ]
        found.append(f"{which} {name}: {', '.join(each)}")
    return found


def _moves(report: Contents) -> list[str]:
    """Return the moves of parameters from the bare fit, the farthest first."""
    table, found = report.parameters.dropna(subset=["before", "after"]), []
    shift = (table["after"] - table["before"]).to_numpy()
    sd = np.maximum(table["before_sd"].to_numpy(), np.finfo(float).tiny)
    far = np.abs(shift) / sd
    for i in [i for i in np.argsort(-far) if far[i] >= 1]:
        times = "more than 1000" if far[i] > 1_000 else f"{far[i]:.2g}"
        after = number(table["after"].iloc[i])
        found.append(
            f"{table['parameter'].iloc[i]} by {shift[i]:+.3g} to {after} ({times} of "
            "its standard deviations)"
        )
    return found


def _tried(report: Contents) -> str:
    """Return the actions that were executed."""
    if report.action_is_label:
        return "inputs were tried than those of these trials"
    action = np.unique(report.residuals.action, axis=0)
    if len(action) == 1:
        return f"action was tried than {report.setting(action[0])}"
    ends = zip(
        map(split, report.action_labels), action.min(0), action.max(0), strict=True
    )
    ranges = [
        f"{name} from {low:.4g} to {high:.4g} {unit}".rstrip()
        for (name, unit), low, high in ends
    ]
    more = [f"and {len(ranges) - 3} more entries"] if len(ranges) > 3 else []
    tried = ", ".join([*ranges[:3], *more])
    return f"action was tried than these {len(action)}: {tried}"


def _engines(report: Contents) -> list[str]:
    """Return how evidence was found, with the models where that did not serve."""
    of: dict[str, list[str]] = {}
    for name, evidence in report.tracing.evidences.items():
        of.setdefault(evidence.engine, []).append(name)
    ways = {"linear": "linearized models", "smc": "sequential Monte Carlo"}
    ways["importance"] = "least squares and importance sampling"
    return [
        ways.get(engine, engine) + f" ({', '.join(sorted(names))})" * (engine == "smc")
        for engine, names in of.items()
    ]
