"""Summary of a report: its first line, and a paragraph of four sentences.

The sentences say what is missing or that nothing is, the error before and after on
trials that had no part in the verdict, what is left, and what to measure next.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sbi_active.criticism.contradictions import MissedTrial, OutlyingTrial
from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents, by_channel, root_mean_square
from sbi_active.criticism.report.words import (
    TOLD,
    listed,
    number,
    probability,
    stated,
)
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Array,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.criticism.under_misfit import UNDECLARED, Misfit

#: Trials that refute a verdict where none are named.
NO_PART = "trials that had no part in it"


def verdict_line(report: Contents) -> str:
    """Return the verdict with what limits it, in one line."""
    tracing, bounds = report.tracing, report.tracing.bounds
    likeliest = max(tracing.probabilities, key=tracing.probabilities.__getitem__)
    is_likelier = report.verdict == NONE and likeliest != NONE
    share = stated(tracing.probabilities[likeliest])
    needs_none = report.verdict != NONE and bounds.p_value > LEVEL
    same = not_told_from(tracing, tracing.chosen or [report.verdict])
    missed = () if report.evaluation is None else report.evaluation.missed
    clauses = [
        (True, _verdict(report)),
        (is_likelier, f", no alarm, though {likeliest} is likelier ({share})"),
        (True, _limits(tracing)),
        (needs_none and not bounds.replaces, f"; {narrow_prior(tracing)}"),
        (not tracing.misfit and tracing.beside, f", beside {ModelKey(tracing.beside)}"),
        (
            tracing.stand_in,
            f", a stand-in for {UNDECLARED}: {'; '.join(tracing.stand_in)}",
        ),
        (report.guess, f", a guess, not declared: {report.guess}"),
        (not tracing.robust, ", not robust to its prior"),
        (same, f"; no permitted action tells it from {', '.join(same)}"),
        (tracing.set_aside, _counted(tracing.set_aside, "trial", "set aside")),
        (missed, _counted(missed, "held-out trial", "far outside it")),
    ]
    return "Verdict: " + "".join(text for holds, text in clauses if holds)


def not_told_from(tracing: Tracing, names: Collection[str]) -> list[str]:
    """Return the other names that no permitted action tells from some."""
    groups = [group for group in tracing.equivalent if not group.isdisjoint(names)]
    return sorted(frozenset().union(*groups).difference(names))


def first_paragraph(report: Contents) -> str:
    """Return the four sentences."""
    return " ".join(sentences(report))


def sentences(report: Contents) -> tuple[str, str, str, str]:
    """Return what is missing, the error before and after, what is left, what next."""
    return _missing(report), _errors(report), _left(report), _next(report)


def _missing(report: Contents) -> str:
    tracing, misfit, verdict = report.tracing, report.tracing.misfit, report.verdict
    if verdict == NONE:
        return f"The bare model explains the {report.num_trials} trials."
    misses = f"The bare model misses the {report.num_trials} trials"
    if misfit is not None and verdict != OUTLIER:
        misses += f" by more than the sensor's error of {sizes(report, misfit.sensor)}"
        return f"{misses}: {_helping(report, misfit)}."
    which = suspects_in_words(tracing)
    found = {
        UNEXPLAINED: "no declared effect explains what it misses",
        SCATTER: "they scatter more than the declared noise",
        OUTLIER: f"{which} does not agree with the others",
    }.get(verdict, f"it lacks {_described(report, tracing.chosen)}")
    withheld = f"{tracing.instead_of} is not named, as the warnings say"
    if tracing.beside:
        most = ModelKey(tracing.beside)
        found = f"{most} explains most of what it misses, and not all"
    elif tracing.instead_of:
        found = f"{found}; {withheld}" if verdict == OUTLIER else withheld
    elif tracing.stand_in:
        what = _described(report, tracing.chosen)
        found = f"{what} stands in for {UNDECLARED}"
    elif tracing.chosen and tracing.bounds.p_value > LEVEL:
        found += f"; but {narrow_prior(tracing)}"
    others = [name for name in report.credible_set if name != verdict]
    shares = [
        f"{label(tracing, n)} ({stated(report.probabilities[n])})" for n in others
    ]
    if others and not tracing.instead_of:
        found += f"; not excluded: {', '.join(shares)}"
    return f"{misses}: {found}."


def _helping(report: Contents, misfit: Misfit) -> str:
    """Return what helps where every model misses, and what of it is named."""
    if not misfit.helps:
        return "no declared effect helps to predict them"
    line = misfit_line(report.verdict, misfit).removeprefix(f"{UNEXPLAINED}: ")
    described = _described(report, misfit.helps)
    return line if described == listed(misfit.helps) else f"{line}; {described}"


def _described(report: Contents, names: Sequence[str]) -> str:
    """Return effects with what each does."""
    words = {e.name: e.describe.rstrip(".") for e in report.tracing.estimates}
    told = [f"{n} ({words[n]})" if words.get(n) else n for n in names]
    return listed(told) if told else ""


def _errors(report: Contents) -> str:
    tracing, misfit = report.tracing, report.tracing.misfit
    if misfit is not None and report.verdict != OUTLIER:
        return _left_out_errors(report, misfit)
    if report.evaluation is None:
        return "No trial was scored."
    before, after = map(number, report.rmse)
    if report.verdict == NONE:
        return f"Its RMSE on {NO_PART} is {before}."
    folds = report.evaluation.scheme != "held out"
    withdrawn = folds and (tracing.refuted or tracing.bounds.replaces)
    model = tracing.instead_of if withdrawn else added(report)
    change = f"from {before} to {after}"
    ratio, interval = report.before_after.set_index("metric").loc["rmse"].iloc[2:]
    if interval is not None:
        low, high = map(number, interval)
        change += f" (ratio {number(ratio)}, 90 % interval {low} to {high})"
    return f"With {model}, the RMSE on {NO_PART} goes {change}."


def _left_out_errors(report: Contents, misfit: Misfit) -> str:
    bare, others = misfit.of(NONE), f"left-out {misfit.left_out}"
    refuted = report.tracing.instead_of if report.tracing.refuted else ""
    name = str(ModelKey(misfit.helps)) if misfit.helps else refuted
    if not name:
        return f"Its error on {others} is {sizes(report, bare.left_out)}."
    model = misfit.of(name)
    change = _change(report, bare.left_out, model.left_out)
    told = f"With {name} the error on {others} goes from {change}"
    if model.held_out is not None and bare.held_out is not None:
        held_out = _change(report, bare.held_out, model.held_out)
        told += f", on held-out trials from {held_out}"
    return f"{told}."


def _left(report: Contents) -> str:
    found = report.residuals_after or report.residuals
    left = by_channel(found.x - found.mean, found)
    own = root_mean_square(left, (0, 1))
    sensor = report.sensor
    model = added(report) if report.residuals_after else "the bare model"
    told = f"What {model} leaves has a root mean square of "
    if sensor is not None and sensor.shape in ((1,), own.shape):
        own = own if len(sensor) > 1 else root_mean_square(left)[None]
        times = [f"{size:.2g}" for size in own / sensor]
        told += f"{sizes(report, own)}, {', '.join(times)} times the sensor's error"
    else:
        own = root_mean_square(found.refitted)
        told += f"{own:.2g} times the prediction's standard deviation"
    misfit = report.tracing.misfit
    if misfit is not None and misfit.helps:
        remains = misfit.of(str(ModelKey(misfit.helps))).remains
        told += f"; {100 * remains:.0f} % of the excess over the sensor's remains"
        told += "" if misfit.passes else f", of {UNDECLARED} that it may imitate"
    trials = report.residuals_by_trial
    if len(trials) > 1:
        worst = trials.iloc[0]
        unit = "the prediction" if misfit is None else "the sensor"
        told += (
            f"; trial {worst['trial']} has most, "
            f"{number(worst['deviations'])} deviations of {unit}"
        )
    return f"{told}."


def _next(report: Contents) -> str:
    plan = report.next_action
    if plan is not None and plan.action is not None:
        names, rest = plan.separates[: TOLD.names], plan.separates[TOLD.names :]
        names += (f"{len(rest)} more",) if rest else ()
        told = f", to tell {listed(names)} apart" if names else ""
        return f"Measure next at {report.setting(plan.action)}{told}."
    if report.severe_tests:
        return f"Measure next {', or '.join(report.tests)}: this tests the verdict."
    if report.verdict == NONE:
        return "Nothing asks for another trial." if plan else "No trial was planned."
    return {
        UNEXPLAINED: "Before the next trial, declare what else may be missing.",
        SCATTER: "Measure next an action again, to see how large the scatter is.",
        OUTLIER: f"Check and repeat {suspects_in_words(report.tracing)} next.",
    }.get(report.verdict, "Measure next at actions that were not tried.")


def _verdict(report: Contents) -> str:
    """Return the verdict with its probability."""
    tracing, verdict = report.tracing, report.verdict
    if tracing.misfit is not None and verdict != OUTLIER:
        return misfit_line(verdict, tracing.misfit)
    family = open_form(report)
    if family is not None:
        return family
    p = tracing.probabilities.get(verdict) if not tracing.instead_of else None
    return verdict if p is None else f"{verdict} ({stated(p)})"


def misfit_line(verdict: str, misfit: Misfit) -> str:
    """Return the verdict where every model misses: what is named, or what helps."""
    named = misfit.named
    if not misfit.helps:
        return "unexplained: the model misses the trials, and no declared effect helps"
    if not named:
        return (
            f"unexplained: {ModelKey(misfit.helps)} predicts better, and is not named "
            "as the cause"
        )
    told = [_supported(misfit, n) for n in named]
    if len(named) == 1:
        line = f"{verdict}, probably the cause ({told[0]})"
        if family := misfit.open_forms.get(named[0]):
            line = f"{family}, form open: nearest is {named[0]} ({told[0]})"
    else:
        pairs = zip(named, told, strict=True)
        line = f"{verdict}, probably the cause: "
        line += ", ".join(f"{n} ({each})" for n, each in pairs)
    # An effect that imitates one that was not declared leaves something of it.
    line += "" if misfit.passes else f", beside {UNDECLARED}"
    rest = [n for n in misfit.helps if n not in named]
    verb = "helps" if len(rest) == 1 else "help"
    return line + (f"; {', '.join(rest)} {verb} to predict" if rest else "")


def _supported(misfit: Misfit, name: str) -> str:
    """Return the two numbers by which an effect is named, and whether of a family."""
    own, family = misfit.support[name], misfit.open_forms.get(name)
    told = f"inclusion {probability(own.inclusion)}, "
    told += f"leaves {100 * own.remains:.0f} % of the excess"
    is_one = len(misfit.named) == 1
    return told if family is None or is_one else f"{family}, form open; {told}"


def open_form(report: Contents) -> str | None:
    """Return the families of the forces that are chosen where no form is certain."""
    tracing = report.tracing
    families = {e.name: e.family for e in tracing.estimates}
    chosen = {families.get(name, "") for name in tracing.chosen}
    p = tracing.probabilities
    if not chosen or p.get(tracing.verdict, 0.0) >= TOLD.certain:
        return None
    if not all(family.startswith((FAMILY, COUPLING)) for family in chosen):
        return None
    shares = {
        key: share
        for key, share in p.items()
        if chosen <= {families.get(name) for name in key.split(" + ")}
    }
    forms = sorted(shares.items(), key=lambda item: -item[1])
    told = [f"{name} ({stated(share)})" for name, share in forms if share >= TOLD.share]
    cause = " and ".join(sorted(chosen))
    return f"{cause} ({stated(sum(shares.values()))}), form open: {', '.join(told)}"


def _limits(tracing: Tracing) -> str:
    """Return the trials that a verdict is about or rests on, and what it withdraws."""
    if tracing.bounds.replaces:
        return f", and not {tracing.instead_of}: {narrow_prior(tracing)}"
    if tracing.misfit is not None and tracing.refuted and tracing.verdict != OUTLIER:
        where = tracing.refuted_on or NO_PART
        return f": {tracing.instead_of} does not lower the error on {where}"
    about = f": {suspects_in_words(tracing)}" if tracing.verdict == OUTLIER else ""
    relies = rests(tracing) if tracing.needed else ""
    if tracing.instead_of:
        which = f", which {relies}" if relies else ""
        return f"{about}, and not {tracing.instead_of}{which}"
    return about + (f", {relies}" if relies else "")


def _counted(which: Sequence[MissedTrial | OutlyingTrial], kind: str, are: str) -> str:
    """Return the trials of a kind, or their number where they are many."""
    if len(which) > TOLD.names:
        return f"; {len(which)} {kind}s are {are}"
    names = " and ".join(trial.name for trial in which)
    return f"; {kind}{'s' * (len(which) > 1)} {names} {_are(which)} {are}"


def _are(which: Sequence[object]) -> str:
    return "is" if len(which) == 1 else "are"


def rests(tracing: Tracing) -> str:
    """Return on which trials a verdict rests."""
    names = [_called(tracing, index) for index in tracing.needed]
    if len(names) == 1:
        return f"rests on trial {names[0]} alone"
    return f"falls without any one of trials {listed(names)}"


def narrow_prior(tracing: Tracing) -> str:
    """Return a clause on the wider prior with which the bare model is as good."""
    bounds = tracing.bounds
    where = [
        f"{p.name} lies at its prior's {p.side} bound {p.bound:.6g}"
        for p in bounds.parameters
        if p.model == NONE
    ]
    if not where:
        return (
            "no permitted action tells it from the bare model with parameters that its "
            "prior makes improbable, and with a wider prior the model is as good"
        )
    needs_none = bounds.p_value > LEVEL
    what = "needs no effect" if needs_none else "explains the trials as well"
    return f"{' and '.join(where)}, and with a wider prior the model {what}"


def suspects(tracing: Tracing) -> tuple[float, ...]:
    """Return the indices of trials that hold 90 % of a gross error's probability."""
    found, total = [], 0.0
    for index, share in tracing.outliers.items():  # most probable first
        if total >= TOLD.mass:
            break
        found.append(index)
        total += share
    return (*found,)


def suspects_in_words(tracing: Tracing) -> str:
    """Return the trials of which one may have a gross error."""
    if not tracing.outliers:
        return "one trial"
    names = [_called(tracing, index) for index in suspects(tracing)]
    return f"trial {listed(names, 'or')}"


def _called(tracing: Tracing, index: float) -> str:
    return tracing.trial_names.get(index, f"{index:g}")


def label(tracing: Tracing, name: str) -> str:
    """Return the name of a model in a report: the outlier with its trial."""
    is_known = name == OUTLIER and tracing.outliers
    return f"{name}: {suspects_in_words(tracing)}" if is_known else name


def added(report: Contents) -> str:
    """Return the additions to the bare model, in words."""
    tracing, beside = report.tracing, report.tracing.beside
    if tracing.misfit is not None and tracing.chosen:
        return tracing.model
    words = {
        NONE: "nothing",
        UNEXPLAINED: f"{ModelKey(beside)} and " * bool(beside) + "a residual process",
        SCATTER: "larger noise",
        OUTLIER: f"{suspects_in_words(tracing)} set aside",
    }
    return words.get(report.verdict, report.verdict)


def sizes(report: Contents, values: Array) -> str:
    """Return a number by channel, with names where there are several, and units."""
    return _by_channel(report, [number(float(value)) for value in values])


def _change(report: Contents, before: Array, after: Array) -> str:
    """Return two errors by channel, as in "154 to 52.1 N"."""
    pairs = zip(before, after, strict=True)
    return _by_channel(
        report, [f"{number(float(a))} to {number(float(b))}" for a, b in pairs]
    )


def _by_channel(report: Contents, texts: Sequence[str]) -> str:
    several = len(texts) > 1
    return ", ".join(
        f"{f'{name} ' * several}{text} {unit}".rstrip()
        for (name, unit), text in zip(report.channels(len(texts)), texts, strict=True)
    )
