"""Section of a report on the error, the parameters, and the next step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import METRICS
from sbi_active.criticism.report.headline import added
from sbi_active.criticism.report.names import called, joined, setting
from sbi_active.criticism.report.numbers import (
    FEWEST_DRAWS,
    estimated,
    number,
    probability,
)
from sbi_active.criticism.report.pictures import pictured
from sbi_active.criticism.results import (
    NONE,
    SCATTER,
    UNEXPLAINED,
    Evaluation,
    NextAction,
)
from sbi_active.criticism.under_misfit import Misfit
from sbi_active.display.page import Section
from sbi_active.display.table import Table

SEVERE = (
    "The first paragraph names the actions that put the verdict to the test most. The "
    "free residual is the bare model and a smooth function of the action, both as "
    "fitted to the trials; the difference is the root mean square over x, in standard "
    "deviations of the verdict's prediction, noise included."
)
FEW_PAIRS = 8  # scored trials below which the pairs stand in place of an interval


def errors(report: Contents) -> Section:
    """Return the error before and after, on trials that had no part in it."""
    evaluation, title = report.evaluation, "Error before and after"
    if evaluation is None:
        return Section(title, ("No trial was scored.",))
    rows = [
        (
            METRICS.get(str(name), str(name)),
            number(before),
            number(after),
            number(ratio),
            "" if interval is None else " to ".join(map(number, interval)),
        )
        for name, before, after, ratio, interval in report.before_after.itertuples(
            index=False
        )
    ]
    num = len(evaluation.trials)
    if evaluation.scheme == "held out":
        text = [f"{num} held-out trials, which had no part in choosing or fitting."]
    else:
        whole = report.verdict
        if report.tracing.misfit is not None and report.tracing.chosen:
            whole = report.tracing.model
        same = sum(verdict == whole for verdict in evaluation.selected)
        text = [
            f"{num} trials, each predicted by models that were chosen and fitted "
            f"without it ({evaluation.scheme}); {same} of {num} such verdicts are "
            f"{whole}, that of all trials."
        ]
    text.append(
        "RMSE and energy score are in units of x: less is better, and their ratio is "
        "after / before. Of the other two it is the difference, after - before: more "
        "density is better, and the share should be 0.9."
    )
    pairs: list[str] = []
    if num < FEW_PAIRS:
        text.append(
            f"Below {FEW_PAIRS} trials an interval over trials covers too little; "
            "these are the pairs:"
        )
        pairs = _pairs(evaluation)
    header = ("metric", "before", "after", "ratio or difference", "90 % interval")
    return Section(
        title,
        tuple(text),
        items=tuple(pairs),
        table=Table(header, rows),
        picture=pictured(report, "before_after"),
    )


def parameters(report: Contents) -> Section:
    """Return theta before and after, and phi."""
    units = {e.name: e.units for e in report.tracing.estimates if e.units}
    evidences = report.tracing.evidences
    draws = [
        evidences[name].effective_sample_size if name in evidences else np.inf
        for name in (NONE, report.tracing.model)
    ]
    header = ["parameter", "bare model", f"with {added(report)}"]
    rows = []
    for name, before, before_sd, after, after_sd in report.parameters.itertuples(
        index=False
    ):
        label = f"{name} [{units[name]}]" if name in units else str(name)
        cells = (
            estimated(before, before_sd, draws[0]),
            estimated(after, after_sd, draws[1]),
        )
        rows.append((label, *cells))
    together = report.combinations
    text = (f"Of parameters together, {together}.",) if together else ()
    models = [evidences[n] for n in (NONE, report.tracing.model) if n in evidences]
    if any(e.narrow is not None or e.best is not None for e in models):
        text += (
            "Of a model that misses the trials the best fit stands here, with a "
            "deviation that knows of it; of others the posterior's mean and deviation.",
        )
    if min(draws) < FEWEST_DRAWS:
        text += (
            f'"about": below {FEWEST_DRAWS:.0f} effective samples are behind it, too '
            "few for a deviation.",
        )
    if report.verdict == NONE:
        alone = Table(header[:2], [row[:2] for row in rows])
        return Section("Parameters", text, table=alone)
    return Section("Parameters before and after", text, table=Table(header, rows))


def next_action(report: Contents) -> Section:
    """Return the action that tells most, and what no permitted action tells."""
    chosen, title = report.next_action, "Next action"
    if chosen is None:
        return Section(
            title, ("None was asked for: there is no set of permitted actions.",)
        )
    best = float(np.nanmax(chosen.information_gain, initial=0.0))
    if chosen.action is not None:
        question = f" between {joined(chosen.separates)}" if chosen.separates else ""
        action = setting(report.action_labels, chosen.action)
        text = [f"{action}: at least {best:.2f} nats{question} (a lower bound)."]
    else:
        text = [_nothing_to_tell(report, chosen, best)]
    if report.tracing.misfit is not None and len(chosen.separates) > 1:
        text.append(_by_error(report.tracing.misfit))
    if report.severe_tests:
        text.append(SEVERE)
    items = (*_by_range(report, chosen), *_inseparable(report, chosen))
    return Section(title, tuple(text), items=items)


def _by_range(report: Contents, chosen: NextAction) -> Iterator[str]:
    """Yield actions that separate forms of a force, in the tried range and beyond."""
    for where, action, gain in (
        ("within the range tried", chosen.within, chosen.within_gain),
        ("beyond the range tried", chosen.beyond, chosen.beyond_gain),
    ):
        if action is not None:
            told = f"at least {gain:.2f} nats between {joined(chosen.separates)}"
            yield f"{where}, {setting(report.action_labels, action)}: {told}"


def _nothing_to_tell(report: Contents, chosen: NextAction, best: float) -> str:
    """Return the reason not to choose an action; final only if the bare model holds."""
    found = (
        "no permitted action tells more about which declared model is right than "
        f"{max(best, 0.001):.3f} nats."
    )
    if len(chosen.separates) == 1:
        found = f"of the declared models only {chosen.separates[0]} is left."
    if len(chosen.separates) == 1 and report.tracing.misfit is not None:
        found = (
            f"of the declared models only {chosen.separates[0]} predicts left-out "
            f"{report.tracing.misfit.left_out} so well."
        )
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


def _inseparable(report: Contents, chosen: NextAction) -> list[str]:
    """Return each group that no permitted action separates, and what would."""
    beyond = None if chosen.outside is None else frozenset(chosen.outside_separates)
    groups = [*chosen.inseparable]
    if beyond is not None and beyond not in groups:
        groups.append(beyond)
    items = []
    for group in groups:
        item = f"no permitted action separates {_in_words(group)}"
        if group == beyond and chosen.outside is not None:
            item += (
                f"; {setting(report.action_labels, chosen.outside)}, which is not "
                "permitted, would: "
                f"at least {chosen.outside_gain:.2f} nats"
            )
        items.append(item)
    return items


def _in_words(group: frozenset[str]) -> str:
    *first, last = sorted(group)
    return f"{', '.join(first)} and {last}" if first else last


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
