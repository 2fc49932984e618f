"""Sections of a report: residuals, errors before and after, next action, record."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbi_active.criticism.data.units import split
from sbi_active.criticism.report import models
from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.figures import METRICS, pictured
from sbi_active.criticism.report.predicted import predicted_section
from sbi_active.criticism.report.summary import (
    added,
    first_paragraph,
    sizes,
    verdict_line,
)
from sbi_active.criticism.report.words import TOLD, called, listed, number, probability
from sbi_active.criticism.results import (
    NONE,
    SCATTER,
    UNEXPLAINED,
    Array,
    Evaluation,
    NextAction,
    Residuals,
)
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.display.page import Page, Section
from sbi_active.display.table import Table
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
    yield residuals(report)
    yield by_trial(report)
    yield before_and_after(report)
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


def residuals(report: Contents) -> Section:
    """Return the size of the residuals before and after.

    Where every model misses, a prediction is as wide as the misfit: residuals are then
    told in deviations of the sensor.
    """
    models = [("bare model", report.residuals)]
    if report.residuals_after is not None:
        models.append((f"with {added(report)}", report.residuals_after))
    by = _by_prediction if report.tracing.misfit is None else _by_sensor
    told, table = by(report, models)
    before, detection = report.residuals, report.detection
    noise = {
        "declared": "The noise is declared.",
        "estimated": "The noise is uncertain, and what it may be is summed over.",
        "stochastic": "The noise is the simulator's own.",
    }[before.noise]
    p = detection.p_value
    least = f"p {f'= {p:.2g}' if p >= TOLD.smallest_p else f'< {TOLD.smallest_p:g}'}"
    text = [
        told,
        f"{noise} Chi-square of the bare model "
        f"{detection.chi_square:.1f} on {detection.degrees_of_freedom:.1f} degrees of "
        f"freedom, {least}; log Bayes factor against it "
        f"{detection.log_bayes_factor:.1f} nats, where "
        f"{detection.threshold:.1f} raises the alarm.",
    ]
    if before.times is not None:
        text.append(f"Correlation of neighboring errors {before.correlation:.2f}.")
    return Section("Residuals", text, table=table, picture=pictured("residuals"))


def _by_prediction(
    report: Contents, models: list[tuple[str, Residuals]]
) -> tuple[str, Table]:
    rows = [[name, *_sizes(z.refitted)] for name, z in models]
    header = ["residuals [sd]", "root mean square", "beyond 2"]
    told = (
        "Observation minus prediction, in standard deviations of the prediction: a "
        "root mean square of about 1, and 5 % beyond 2, where the model holds. Models "
        "are fitted to all trials."
    )
    return told, Table(header, rows)


def _by_sensor(
    report: Contents, models: list[tuple[str, Residuals]]
) -> tuple[str, Table]:
    assert report.sensor is not None
    rows = []
    for name, found in models:
        left = by_channel(found.x - found.mean, found)
        size = sizes(report, root_mean_square(left, (0, 1)))
        rows.append([name, size, number(float(root_mean_square(left / report.sensor)))])
    header = ["residuals", "in units of x", "in deviations of the sensor"]
    sensor = sizes(report, report.sensor)
    told = "Root mean square of what each model leaves; the sensor's error is"
    return f"{told} {sensor}.", Table(header, rows)


def by_trial(report: Contents) -> Section:
    """Return the root mean square residual of the worst trials, and where it is."""
    tracing, table = report.tracing, report.residuals_by_trial
    found = report.residuals_after or report.residuals
    channels = report.channels(by_channel(found.x, found).shape[2])
    rows = [
        [trial.name, "", number(trial.size), "set aside: on the fit to the others"]
        for trial in tracing.set_aside
    ]
    shown = table.head(max(TOLD.trials - len(rows), 0))
    for one in shown.to_dict("records"):
        name, unit = channels[one["channel"]]
        where = [name] * (len(channels) > 1)
        where += [] if np.isnan(one["time"]) else [f"t = {number(one['time'])} s"]
        size = f"{number(one['size'])} {unit}".rstrip()
        rows.append([one["trial"], size, number(one["deviations"]), ", ".join(where)])
    model = "the bare model" if report.residuals_after is None else added(report)
    rest = len(table) - len(shown)
    text = f"Root mean square with {model}, the worst first"
    text += f"; {rest} more {'is' if rest == 1 else 'are'} no worse." if rest else "."
    of = "the prediction" if tracing.misfit is None else "the sensor"
    where = " where it is largest" if len(channels) > 1 else ""
    header = ["trial", f"in units of x{where}", f"in deviations of {of}", "largest"]
    return Section("Residuals by trial", [text], table=Table(header, rows))


def before_and_after(report: Contents) -> Section:
    """Return the error before and after, on trials that had no part in it."""
    evaluation, title = report.evaluation, "Error before and after"
    if evaluation is None:
        return Section(title, ["No trial was scored."])
    rows = [
        [
            METRICS.get(str(name), str(name)),
            *map(number, (before, after, ratio)),
            "" if interval is None else " to ".join(map(number, interval)),
        ]
        for name, before, after, ratio, interval in report.before_after.itertuples(
            index=False
        )
    ]
    num, whole = len(evaluation.trials), report.verdict
    if report.tracing.misfit is not None and report.tracing.chosen:
        whole = report.tracing.model
    same = sum(verdict == whole for verdict in evaluation.selected)
    scheme = f"{num} held-out trials, which had no part in choosing or fitting."
    if evaluation.scheme != "held out":
        scheme = (
            f"{num} trials, each predicted by models that were chosen and fitted "
            f"without it ({evaluation.scheme}); {same} of {num} such verdicts are "
            f"{whole}, that of all trials."
        )
    text = [
        scheme,
        "RMSE and energy score are in units of x: less is better, and their ratio is "
        "after / before. Of the other two it is the difference, after - before: more "
        "density is better, and the share should be 0.9.",
    ]
    if num < TOLD.pairs:
        text.append(
            f"Below {TOLD.pairs} trials an interval over trials covers too little; "
            "these are the pairs:"
        )
    header = ["metric", "before", "after", "ratio or difference", "90 % interval"]
    return Section(
        title,
        text,
        items=_pairs(evaluation) if num < TOLD.pairs else (),
        table=Table(header, rows),
        picture=pictured("before_after"),
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
        name = called(evaluation.names, i) if evaluation.names else int(trial)
        found.append(f"{which} {name}: {', '.join(each)}")
    return found


def _sizes(z: Array) -> list[str]:
    """Return the root mean square, and the share beyond 2."""
    z = z[np.isfinite(z)]
    if not z.size:
        return ["", ""]
    return [f"{root_mean_square(z):.2f}", f"{100 * np.mean(np.abs(z) > 2):.0f} %"]
