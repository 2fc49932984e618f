"""Sections on the models: their probabilities, what separates them, parameters."""

from __future__ import annotations

from collections.abc import Iterator
from math import isnan

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import pictured
from sbi_active.criticism.report.summary import added, label, sizes
from sbi_active.criticism.report.words import (
    TOLD,
    estimated,
    listed,
    number,
    probability,
)
from sbi_active.criticism.results import NONE, Estimate
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.display.page import Section
from sbi_active.display.table import Table

CONDITION = (
    "P holds among the declared effects alone: an effect that nobody declared may pass "
    "for them."
)
#: What an effect that helps, and is not named as the cause, is good for.
PREDICTS = "use it to predict inside the tried range, and do not read phi as physics"


def effects(report: Contents) -> Section:
    """Return every model alone, and the sets of effects that have a share.

    Where trials that had no part in it speak against the most probable model, or every
    model misses, probabilities by the fitted trials alone would contradict the verdict:
    they are left out.
    """
    tracing = report.tracing
    has_p = report.has_probabilities
    has_sets = has_p and any(map(tracing.has_several, tracing.probabilities))
    header = ["model", *["P"] * has_p, *["P in any set"] * has_sets]
    header += ["phi", "log BF", "ESS", *["90 % set"] * has_p]
    phi = {e.name: _phi(e) for e in tracing.estimates}
    null = tracing.evidences[NONE].log_evidence
    rows, left_out = [], 0
    for name, p in tracing.probabilities.items():
        if tracing.has_several(name) and p < TOLD.share and name != tracing.model:
            left_out += 1
            continue
        fit, order = ["", ""], -np.inf
        if name in tracing.evidences:
            found = tracing.evidences[name]
            order = found.log_evidence - null
            fit = [f"{order:.1f}", f"{found.effective_sample_size:.0f}"]
        share = probability(tracing.inclusion.get(name, p)) if name in phi else ""
        inside = "yes" if name in tracing.credible_set else ""
        cells = [label(tracing, name), *[probability(p)] * has_p, *[share] * has_sets]
        cells += [phi.get(name, ""), *fit, *[inside] * has_p]
        rows.append((-p if has_p else 0.0, -order, cells))
    rows.sort(key=lambda row: row[:2])
    table = Table(header, [cells for *_, cells in rows])
    text = _explained(report, has_p=has_p, has_sets=has_sets, left_out=left_out)
    picture = pictured("probabilities") if has_p else None
    return Section("Effects", [*text], table=table, picture=picture)


def _phi(e: Estimate) -> str:
    """Return the strength of an effect if it alone is added."""
    pairs = zip(e.mean, e.sd, strict=True)
    told = ", ".join(estimated(m, sd, e.effective_sample_size) for m, sd in pairs)
    return f"{told} {e.units}".strip()


def _explained(
    report: Contents, *, has_p: bool, has_sets: bool, left_out: int
) -> Iterator[str]:
    tracing = report.tracing
    told = "P: probability of the model given the trials. " * has_p
    told += (
        "phi: strength of the effect if it alone is added. log BF: log Bayes factor "
        "against the bare model, nats. ESS: effective samples behind it, below "
        f"{TOLD.draws:.0f} too few for a deviation of phi."
    )
    if has_p:
        told += (
            " 90 % set: the smallest set of models that holds 90 % of the probability."
        )
    yield told
    if tracing.instead_of:
        yield (
            f"By the fitted trials alone {tracing.instead_of} would be probable; it is "
            "not named, as the warnings say."
        )
    if has_sets:
        yield "P in any set: that of the effect being there, alone or with others."
    if left_out and has_p:
        many = "sets of several effects have" if left_out > 1 else "set of several has"
        yield f"{left_out} more {many} P < {TOLD.share:g}."
    if tracing.chosen:
        yield CONDITION
    if report.guess is not None:
        yield (
            f"What it leaves follows {report.guess}, with x the output, x' its slope, "
            "xi the action and t the time in the trial: a guess, not declared, "
            f"{tracing.guesses[0][1]:.1f} nats above the residual process."
        )


def admitted_models(report: Contents, misfit: Misfit) -> Section:
    """Return the error of every admitted model on trials it was not fitted to."""
    has_held = any(m.held_out is not None for m in misfit.models)
    header = ["model", "share", f"left-out {misfit.left_out}", "excess that remains"]
    rows = []
    for m in misfit.models:
        share = probability(m.probability) if m.probability > 0 else "not admitted"
        cells = [m.name, share, sizes(report, m.left_out), f"{100 * m.remains:.0f} %"]
        held_out = "" if m.held_out is None else sizes(report, m.held_out)
        rows.append([*cells, *[held_out] * has_held])
    return Section(
        "Models that predict",
        [*_admitted(report, misfit)],
        items=[*_helping(misfit)],
        table=Table([*header, *["held-out trials"] * has_held], rows),
    )


def _admitted(report: Contents, misfit: Misfit) -> Iterator[str]:
    error = "a residual process of unknown size and time scale"
    name, near = "the process", "tenth"
    scale = f" and a time scale of {number(misfit.time_scale)} s"
    if isnan(misfit.time_scale):  # x has no time axis
        error = "an error of unknown size in each number, beside the sensor's"
        name, near, scale = "that error", "fifth", ""
    if misfit.left_out == "trials":  # fewer of them do not tell
        error += ", or a parameter that differs from trial to trial"
    yield (
        f"Every model carries {error}, so that one evidence serves alarm and verdict. "
        "Admitted are the models whose "
        f"error on left-out {misfit.left_out}, in units of what the others let expect, "
        f"is within a {near} of the smallest, and what is more probable than these by "
        "ten nats; shares are among them. Errors are root mean squares of models "
        f"fitted without what they predict. The sensor's error is "
        f"{sizes(report, misfit.sensor)}; the excess is what is beyond it, as a share "
        "of the bare model's."
    )
    model = report.tracing.instead_of or "the verdict's model"
    yield (
        f"Beside {model} {name} has {misfit.size:.2g} times the sensor's standard "
        f"deviation{scale}."
    )


def _helping(misfit: Misfit) -> Iterator[str]:
    for name in misfit.helps:
        own = misfit.support[name]
        yield (
            f"{name}: probability of being there {probability(own.inclusion)}, of a "
            f"better prediction of a new trial {probability(own.better)}; the "
            f"verdict gains {own.gained:.0f} nats by it, and "
            f"{100 * own.remains:.0f} % of the excess of the fit without it remains"
            + f"; guesses in its place gain {own.guessed:.0f} nats over it"
            * (own.guessed > 1)
            + f"; {PREDICTS}" * (name not in misfit.named)
        )
    for name, others in misfit.instead.items():
        yield (
            f"In place of {name}, {listed(others, 'or')} may be there: left-out "
            f"{misfit.left_out} are not surely predicted worse with it"
        )


def equivalences(report: Contents) -> Section:
    """Return the groups of models that nothing separates, or not these trials."""
    tracing = report.tracing
    near = [group for group in tracing.near if group not in tracing.equivalent]
    kinds = [
        (tracing.equivalent, "no permitted action separates them"),
        (near, "not separated by these trials; another action may"),
        (
            _joined(tracing.aliases),
            "nearly the same here, apart by less than the noise; repeated trials may "
            "separate them",
        ),
    ]
    items = [
        f"{' = '.join(sorted(group))}: {why}"
        for groups, why in kinds
        for group in groups
    ]
    by = "these trials" if report.next_action is None else "a permitted action"
    text = [] if items else [f"Every pair of models is separated by {by}."]
    return Section("Equivalence sets", text, items=items)


def _joined(pairs: tuple[frozenset[str], ...]) -> list[frozenset[str]]:
    """Return the groups that pairs with names in common form."""
    groups: list[frozenset[str]] = []
    for pair in pairs:
        touching = [group for group in groups if group & pair]
        groups = [group for group in groups if group not in touching]
        groups.append(pair.union(*touching))
    return groups


def parameters(report: Contents) -> Section:
    """Return theta before and after, and phi."""
    units = {e.name: e.units for e in report.tracing.estimates if e.units}
    evidences = report.tracing.evidences
    models = [evidences.get(name) for name in (NONE, report.tracing.model)]
    draws = [np.inf if e is None else e.effective_sample_size for e in models]
    rows = [
        [
            f"{name} [{units[name]}]" if name in units else str(name),
            estimated(before, before_sd, draws[0]),
            estimated(after, after_sd, draws[1]),
        ]
        for name, before, before_sd, after, after_sd in report.parameters.itertuples(
            index=False
        )
    ]
    together = report.combinations
    is_best = any(e and (e.narrow is not None or e.best is not None) for e in models)
    told = [
        (together, f"Of parameters together, {together}."),
        (
            is_best,
            "Of a model that misses the trials the best fit stands here, with a "
            "deviation that knows of it; of others the posterior's mean and deviation.",
        ),
        (
            min(draws) < TOLD.draws,
            f'"about": below {TOLD.draws:.0f} effective samples are behind it, too '
            "few for a deviation.",
        ),
        (report.tracing.chosen, _moved(report)),
    ]
    text = [sentence for holds, sentence in told if holds]
    header = ["parameter", "bare model", f"with {added(report)}"]
    if report.verdict == NONE:
        alone = Table(header[:2], [row[:2] for row in rows])
        return Section("Parameters", text, table=alone)
    return Section("Parameters before and after", text, table=Table(header, rows))


def _moved(report: Contents) -> str:
    """Return the moves of parameters from the bare fit, the farthest first."""
    table = report.parameters.dropna(subset=["before", "after"])
    shift = (table["after"] - table["before"]).to_numpy()
    sd = np.maximum(table["before_sd"].to_numpy(), np.finfo(float).tiny)
    far = np.abs(shift) / sd
    order = [i for i in np.argsort(-far) if far[i] >= 1]
    if not order:
        return "No parameter moves by more than its standard deviation in the bare fit."
    moves = [
        f"{table['parameter'].iloc[i]} by {shift[i]:+.3g} to "
        f"{number(table['after'].iloc[i])} "
        f"({'more than 1000' if far[i] > 1_000 else f'{far[i]:.2g}'} of its standard "
        "deviations)"
        for i in order[: TOLD.moves]
    ]
    rest = len(order) - len(moves)
    more = f", and {rest} more by at least one" if rest else ""
    return f"Against the bare fit the verdict moves {', '.join(moves)}{more}."
