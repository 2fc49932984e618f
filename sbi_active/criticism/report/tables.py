"""The tables of a report: models, residuals by trial, errors, parameters, tests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf, isnan
from typing import Any

from sbi_active.criticism.report.contents import Contents, by_channel
from sbi_active.criticism.report.figures import METRICS
from sbi_active.criticism.report.summary import added, label, sizes
from sbi_active.criticism.report.words import number, probability, with_error
from sbi_active.criticism.results import NONE
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.display.table import Table


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
    models = [tracing.evidences.get(name) for name in (NONE, tracing.model)]
    draws = [inf if e is None else e.effective_sample_size for e in models]
    rows = []
    for name, *values in report.parameters.to_numpy():
        pairs = zip(values[::2], values[1::2], draws, strict=True)
        each = [with_error(mean, sd, of) for mean, sd, of in pairs]
        rows.append((name + units.get(name, ""), *each[:num]))
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
        evidence, phi, gain, fit = tracing.evidences.get(name), "", -inf, ["", ""]
        if e is not None:
            pairs = zip(e.mean, e.sd, strict=True)
            each = [with_error(m, sd, e.effective_sample_size) for m, sd in pairs]
            phi = f"{', '.join(each)} {e.units}".strip()
        if evidence is not None:
            gain = evidence.log_evidence - null
            draws = f"{evidence.effective_sample_size:.0f}"
            fit = [f"{round(gain, 1) + 0.0:.1f}", draws]
        any_set = probability(tracing.inclusion.get(name, p)) if e else ""
        inside = "yes" if name in tracing.credible_set else ""
        cells = [label(tracing, name), *[probability(p)] * has_p, *[any_set] * has_sets]
        cells += [phi, *fit, *[inside] * has_p]
        rows.append((-p if has_p else 0.0, -gain, cells))
    rows.sort(key=lambda row: row[:2])
    header = ["model", *["P"] * has_p, *["P in any set"] * has_sets, "phi", "log BF"]
    return Table([*header, "ESS", *["90 % set"] * has_p], [cells for *_, cells in rows])


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
