"""Sections on residuals, and on the error before and after."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.figures import METRICS, pictured
from sbi_active.criticism.report.summary import added, sizes
from sbi_active.criticism.report.words import TOLD, called, number
from sbi_active.criticism.results import Array, Evaluation, Residuals
from sbi_active.display.page import Section
from sbi_active.display.table import Table


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
