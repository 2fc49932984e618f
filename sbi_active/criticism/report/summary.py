"""A verdict in words, and what limits it, as clauses."""

from __future__ import annotations

from collections.abc import Collection

from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.words import blocks, listed, number, stated
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Array,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import LEVEL, credible_set
from sbi_active.criticism.under_misfit import UNDECLARED, Misfit

#: Trials that refute a verdict where none are named.
NO_PART = "trials that had no part in it"


def verdict_in_words(report: Contents) -> str:
    """Return the verdict with its probability."""
    tracing, verdict = report.tracing, report.verdict
    if tracing.misfit is not None and verdict != OUTLIER:
        return misfit_line(verdict, tracing.misfit)
    p = tracing.probabilities.get(verdict) if not tracing.instead_of else None
    return _open_form(tracing) or (verdict if p is None else f"{verdict} ({stated(p)})")


def misfit_line(verdict: str, misfit: Misfit) -> str:
    """Return the verdict where every model misses: what is named, or what helps."""
    return blocks("verdict", verdict=verdict, misfit=misfit, undeclared=UNDECLARED)[0]


def _open_form(tracing: Tracing) -> str | None:
    """Return the families of forces that are chosen where no form has P >= .9."""
    families = {e.name: e.family for e in tracing.estimates}
    chosen = {families.get(name, "") for name in tracing.chosen}
    p = tracing.probabilities
    if not chosen or p.get(tracing.verdict, 0.0) >= 0.9:
        return None
    if not all(family.startswith((FAMILY, COUPLING)) for family in chosen):
        return None
    shares = {
        key: share
        for key, share in p.items()
        if chosen <= {families.get(name) for name in key.split(" + ")}
    }
    forms = sorted(shares.items(), key=lambda item: -item[1])
    told = [f"{name} ({stated(share)})" for name, share in forms if share >= 0.01]
    cause = " and ".join(sorted(chosen))
    return f"{cause} ({stated(sum(shares.values()))}), form open: {', '.join(told)}"


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


def not_told_from(tracing: Tracing, names: Collection[str]) -> list[str]:
    """Return the other names that no permitted action tells from some."""
    groups = [group for group in tracing.equivalent if not group.isdisjoint(names)]
    return sorted(frozenset().union(*groups).difference(names))


def suspects_in_words(tracing: Tracing) -> str:
    """Return the trials that hold 90 % of the probability of a gross error."""
    names = [_called(tracing, index) for index in credible_set(tracing.outliers)]
    return f"trial {listed(names, 'or')}" if names else "one trial"


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


def sizes(report: Contents, *values: Array) -> str:
    """Return a number by channel, or "before to after", with names and units."""
    each = [
        " to ".join(number(float(v)) for v in of) for of in zip(*values, strict=True)
    ]
    channels = report.channels(len(each))
    return ", ".join(
        f"{f'{name} ' * (len(each) > 1)}{text} {unit}".rstrip()
        for (name, unit), text in zip(channels, each, strict=True)
    )
