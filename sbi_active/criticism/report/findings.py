"""Section of a report on the models: their probabilities and residuals."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.headline import added
from sbi_active.criticism.report.names import called, joined, named_entries
from sbi_active.criticism.report.numbers import (
    FEWEST_DRAWS,
    estimated,
    number,
    probability,
    with_error,
)
from sbi_active.criticism.report.pictures import pictured
from sbi_active.criticism.report.suspects import label
from sbi_active.criticism.results import NONE, UNEXPLAINED, Array, Residuals
from sbi_active.display.page import Section
from sbi_active.display.table import Table

SHOWN = 0.01  # probability from which a set of several effects stands in the table
SMALLEST_P = 1e-4  # below which the digits of a p-value mean nothing
#: Trials that are listed, the worst; of any number these are a few lines.
MOST_TRIALS = 6


def effects(report: Contents) -> Section:
    """Return every model alone, and the sets of effects that have a share."""
    tracing = report.tracing
    any_set = any(map(tracing.has_several, tracing.probabilities))
    shares = ("P in any set",) if any_set else ()
    header = ("model", "P", *shares, "phi", "log BF", "ESS", "90 % set")
    estimates = {e.name: e for e in tracing.estimates}
    null = tracing.evidences[NONE].log_evidence
    rows, left_out = [], 0
    for name, p in tracing.probabilities.items():
        if tracing.has_several(name) and p < SHOWN and name != tracing.model:
            left_out += 1
            continue
        inclusion, phi, fit, order = ("",) * any_set, "", ("", ""), -np.inf
        if name in estimates:
            e = estimates[name]
            pairs = zip(e.mean, e.sd, strict=True)
            ess = e.effective_sample_size
            phi = ", ".join(estimated(m, sd, ess) for m, sd in pairs) + f" {e.units}"
            share = probability(tracing.inclusion.get(name, p))
            inclusion = (share,) * any_set
        if name in tracing.evidences:
            found = tracing.evidences[name]
            order = found.log_evidence - null
            fit = f"{order:.1f}", f"{found.effective_sample_size:.0f}"
        inside = "yes" if name in tracing.credible_set else ""
        cells = (
            label(tracing, name),
            probability(p),
            *inclusion,
            phi.strip(),
            *fit,
            inside,
        )
        rows.append((-p, -order, cells))
    rows.sort(key=lambda row: row[:2])
    text = [
        "P: probability of the model given the trials. phi: strength of the effect "
        "if it alone is added. log BF: log Bayes factor against the bare model, nats. "
        "ESS: effective samples behind it, below "
        f"{FEWEST_DRAWS:.0f} too few for a deviation of phi. 90 % set: the smallest "
        "set of models that holds 90 % of the probability."
    ]
    if tracing.instead_of:
        text.append(
            f"P is among the declared models and priors by the fitted trials alone; "
            f"{tracing.instead_of} is not named, as the warnings say."
        )
    if any_set:
        text.append(
            "P in any set: probability that the effect is there, alone or with others."
        )
    if left_out:
        sets, verb = ("set", "has") if left_out == 1 else ("sets", "have")
        text.append(f"{left_out} more {sets} of several effects {verb} P < {SHOWN:g}.")
    if report.guess is not None:
        text.append(
            f"A guess, not declared: {report.guess}, "
            f"{tracing.guesses[0][1]:.1f} nats above the residual process."
        )
    return Section(
        "Effects",
        tuple(text),
        table=Table(header, [cells for *_, cells in rows]),
        picture=pictured(report, "probabilities"),
    )


def equivalences(report: Contents) -> Section:
    """Return the groups of models that nothing separates, or not these trials."""
    tracing = report.tracing
    items = [
        f"{joined(group)}: no permitted action separates them"
        for group in tracing.equivalent
    ]
    items += [
        f"{joined(group)}: not separated by these trials; another action may"
        for group in tracing.near
        if group not in tracing.equivalent
    ]
    items += [
        f"{joined(group)}: nearly the same here, apart by less than the noise; "
        "repeated trials may separate them"
        for group in tracing.aliases
    ]
    by = "these trials" if report.next_action is None else "a permitted action"
    text = () if items else (f"Every pair of models is separated by {by}.",)
    return Section("Equivalence sets", text=text, items=tuple(items))


def residuals(report: Contents) -> Section:
    """Return the size of the residuals before and after."""
    before, detection = report.residuals, report.detection
    rows = [("bare model", *_sizes(before.refitted), *_sizes(before.prequential))]
    if report.residuals_after is not None:
        z = report.residuals_after
        sizes = *_sizes(z.refitted), *_sizes(z.prequential)
        rows.append((f"with {added(report)}", *sizes))
    noise = {
        "declared": "The noise is declared.",
        "estimated": "The noise is uncertain, and what it may be is summed over.",
        "stochastic": "The noise is the simulator's own.",
    }[before.noise]
    p = detection.p_value
    text = [
        "Observation minus prediction, in standard deviations of the prediction: a "
        "root mean square of about 1, and 5 % beyond 2, where the model holds. "
        "Refitted to all trials, and each trial predicted from those before it.",
        f"{noise} Chi-square of the bare model "
        f"{detection.chi_square:.1f} on {detection.degrees_of_freedom:.1f} degrees of "
        f"freedom, p {f'= {p:.2g}' if p >= SMALLEST_P else f'< {SMALLEST_P:g}'}.",
    ]
    if found := _beside_the_sensor(report):
        text.insert(0, found)
    if before.times is not None:
        text.append(f"Correlation of neighboring errors {before.correlation:.2f}.")
    header = ("residuals [sd]", "refitted", "beyond 2", "predicted", "beyond 2")
    return Section(
        "Residuals",
        tuple(text),
        table=Table(header, rows),
        picture=pictured(report, "residuals"),
    )


def _beside_the_sensor(report: Contents) -> str:
    """Return the residual in the unit of x, beside the sensor's error if declared."""
    declared = getattr(report.simulator.noise, "measurement_sd", None)
    if declared is None:
        return ""
    models = [("the bare model", report.residuals)]
    if report.residuals_after is not None:
        models.append((added(report), report.residuals_after))
    sensors = np.asarray(declared, dtype=float).reshape(-1)
    several = len(sensors) > 1
    labels = report.channel_names or ()
    clauses = []
    for c, sensor in enumerate(sensors.tolist()):
        name, unit = "", ""
        if len(labels) == len(sensors):
            ((name, unit),) = named_entries([labels[c]])
        each = []
        for model, residuals in models:
            left = residuals.x - residuals.mean
            left = left[..., c] if several else left
            size = float(np.sqrt(np.nanmean(left**2)))
            own = "" if each else f" the sensor's {_measure(sensor, unit)}"
            each.append(
                f"{_measure(size, unit)} with {model}, {size / sensor:.2g} times{own}"
            )
        clauses.append(f"{name or f'channel {c}'}: " * several + ", ".join(each))
    return f"What is left, root mean square: {'; '.join(clauses)}."


def _measure(value: float, unit: str) -> str:
    return f"{number(float(f'{value:.2g}'))} {unit}".rstrip()


def by_trial(report: Contents) -> Section:
    """Return the root mean square residual of the worst trials, and where it is."""
    found = report.residuals_after or report.residuals
    left = _by_channel(found.x - found.mean, found)
    z = _by_channel(found.refitted, found)
    if report.tracing.misfit is not None:  # what is predicted is as wide as the misfit
        z = left / report.tracing.misfit.sensor
    aside = [
        (trial.name, "", number(trial.size), "set aside: on the fit to the others")
        for trial in report.tracing.set_aside
    ]
    sizes = np.array([_rms(own) for own in z])
    order = np.argsort(-np.nan_to_num(sizes, nan=-np.inf), kind="stable")
    order = order[np.isfinite(sizes[order])].tolist()
    worst = order[: max(MOST_TRIALS - len(aside), 0)]
    rows = [_row(report, found, t, left[t], z[t]) for t in worst]
    model = "the bare model" if report.residuals_after is None else added(report)
    rest = len(order) - len(worst)
    text = f"Root mean square with {model}, the worst first"
    text += f"; {rest} more {'is' if rest == 1 else 'are'} no worse." if rest else "."
    of = "the prediction" if report.tracing.misfit is None else "the sensor"
    where = " where it is largest" if left.shape[2] > 1 else ""
    header = ("trial", f"in units of x{where}", f"in deviations of {of}", "largest")
    return Section("Residuals by trial", (text,), table=Table(header, [*aside, *rows]))


def _row(
    report: Contents, found: Residuals, t: int, left: Array, z: Array
) -> tuple[str, ...]:
    """Return the line of one trial, of residuals in both units, shapes (k, c)."""
    place, c = np.unravel_index(np.nanargmax(np.abs(z)), z.shape)
    labels, where = report.channel_names or (), []
    name, unit = f"channel {c}", ""
    if len(labels) == z.shape[1]:
        ((name, unit),) = named_entries([labels[c]])
    if z.shape[1] > 1:
        where.append(name)
    if found.times is not None:
        times = np.broadcast_to(found.times, found.x.shape[:2])
        where.append(f"t = {number(float(times[t, place]))}")
    size = f"{number(_rms(left[:, c]))} {unit}".rstrip()
    return called(found.names, t), size, number(_rms(z)), ", ".join(where)


def _by_channel(x: Array, found: Residuals) -> Array:
    """Return trials, times and channels, (t, k, c); each number is one without time."""
    return x.reshape(len(x), 1 if found.times is None else x.shape[1], -1)


def _rms(x: Array) -> float:
    seen = x[np.isfinite(x)]
    return float(np.sqrt((seen**2).mean())) if seen.size else np.nan


def leave_one_out(report: Contents) -> Section:
    """Return the scores of each trial's prediction from the others."""
    found = report.leave_one_out
    limit = found[0].largest_k
    titles = ["bare model", f"with {added(report)}"]
    rows: list[tuple[str, ...]] = [
        (
            title,
            f"{one.total:.1f}",
            f"{one.pareto_k.max():.2f}",
            ", ".join(called(one.names, i) for i in one.unreliable) or "none",
        )
        for title, one in zip(titles, found, strict=False)
    ]
    text = [
        "Log density of each trial given the others, nats, summed over the "
        f"{report.num_trials} trials: PSIS-LOO, which depends less on the priors of "
        "the effects than log BF does."
    ]
    if len(found) > 1:
        gain = found[1].density - found[0].density
        error = np.sqrt(len(gain)) * gain.std(ddof=1)
        rows.append(("difference", with_error(gain.sum(), error), "", ""))
    elif report.verdict == UNEXPLAINED:
        text.append("The residual process joins the trials, and has no such density.")
    if any(one.unreliable for one in found):
        text.append(
            f"Where the Pareto shape k exceeds {limit:.2f}, a trial decides so much of "
            "the posterior that its density is a guess, too high as a rule."
        )
    header = ("model", "log density", "largest k", f"trials with k > {limit:.2f}")
    return Section("Leave one out", tuple(text), table=Table(header, rows))


def _sizes(z: Array) -> tuple[str, str]:
    """Return the root mean square, and the share beyond 2."""
    z = z[np.isfinite(z)]
    if not z.size:
        return "", ""
    return f"{np.sqrt((z**2).mean()):.2f}", f"{100 * np.mean(np.abs(z) > 2):.0f} %"
