"""Words of a report: numbers and names, a verdict in clauses, and its cautions."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import rankdata

from sbi_active.criticism.contradictions import UNDECLARED, Misfit
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Array,
    ModelKey,
    Residuals,
    Tracing,
)
from sbi_active.criticism.rivals.rival import surprising_outcomes
from sbi_active.criticism.rivals.rival_set import FEW_TRIALS
from sbi_active.criticism.steps.detection import LEVEL, REFUTED, TOO_SMALL, credible_set
from sbi_active.display.page import environment
from sbi_active.messages import Message
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import parameters_of


def blocks(template: str, **values: Any) -> list[str]:
    """Return what a template says: paragraphs, items and titles, a line each.

    Args:
        template: Name of the template, without its ending.
        **values: Values of its names.
    """
    text = _templates().get_template(f"{template}.jinja").render(values)
    return [" ".join(b.split()) for b in re.split(r"\n\s*\n", text) if b.strip()]


@cache
def _templates() -> Any:
    made = environment("sbi_active.criticism", "report")
    for form in (number, probability, stated, listed, counted):
        made.filters[form.__name__] = form
    return made


def stated(value: float) -> str:
    """Return a probability as an equation."""
    text = probability(value)
    return f"P {text}" if text[0] in "<>" else f"P = {text}"


def probability(value: float) -> str:
    """Return a probability in digits that mean something."""
    if value < 0.005:
        return "< .01"
    return "> .99" if value > 0.995 else f"{value:.2f}"


def number(value: float) -> str:
    """Return a number with three digits; nothing for NaN."""
    if np.isnan(value):
        return ""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names in a row, as in "a, b and c"."""
    *first, end = names or [""]
    return f"{', '.join(first)} {last} {end}" if first else end


def counted(trials: Sequence[Any], kind: str, what: str) -> str:
    """Return what trials are, as in "trials a and b are"; many by their number."""
    names = [trial.name for trial in trials]
    verb = f"{'is' if len(names) == 1 else 'are'} {what}"
    if len(names) > 3:
        return f"{len(names)} {kind}s {verb}"
    return f"{kind}{'s' * (len(names) > 1)} {listed(names)} {verb}"


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


def cautions(
    report: Contents, trials: Trials, *, designed: bool = False, loop: Any = None
) -> tuple[Message, ...]:
    """Return the cautions that limit the conclusions, a sentence each.

    Args:
        report: Report without them.
        trials: The measured trials.
        designed: Actions were chosen for their information.
        loop: The comparison, a :class:`.Criticism`, for what was left out of it; None
            asks nothing of it.
    """
    tracing, fit, own = report.tracing, trials.fit, report.residuals
    if report.residuals_after is not None and tracing.chosen:
        own = report.residuals_after
    is_ordered, rough = fit.order == "known", own.roughness
    rough = None if rough is None else rough[rough > 0]
    said = blocks(
        "cautions",
        report=report,
        designed=designed,
        loop=loop,
        num_trials=int(fit.valid.sum()),
        few_trials=FEW_TRIALS,
        is_sorted=is_ordered and not fit.action_is_label and _aliased(fit),
        growth=report.growth if is_ordered else None,
        disagreeing=disagreeing(*surprising_outcomes(own), own),
        rough=None if rough is None else (rough.min(), rough.max()),
        correlation=_correlation(own),
        missed=() if report.evaluation is None else report.evaluation.missed,
        infinity=np.inf,
        refuted=REFUTED,
        too_small=TOO_SMALL,
        edge=_at_edge(tracing, getattr(report.prior, "effects", ())),
        may_be_force=_may_be_force(report),
        no_part=NO_PART,
        suspects=suspects_in_words(tracing),
        rests=rests(tracing) if tracing.needed else "",
        narrow_prior=narrow_prior(tracing),
    )
    return (*map(Message, dict.fromkeys(said)),)


def disagreeing(lost: list[int], kept: list[int], own: Residuals) -> list[str]:
    """Return the trials whose having an outcome, or none, is improbable, in words."""
    kinds = [
        "gave no measurement where the model is sure of one",
        "gave a measurement where the model is sure of none",
    ]
    return [
        f"trial{'s' * (len(which) > 1)} {', '.join(map(own.called, which))} {what}"
        for which, what in zip((lost, kept), kinds, strict=True)
        if which
    ]


def _may_be_force(report: Contents) -> bool:
    """Return whether the simulator takes forces, misses something, and tried none."""
    tracing = report.tracing
    misses = tracing.misfit is not None and not tracing.misfit.passes
    if not (misses or report.verdict == UNEXPLAINED):
        return False
    is_tried = any(e.family.startswith((FAMILY, COUPLING)) for e in tracing.estimates)
    taken = [p.name for p in parameters_of(report.simulator.fn)]
    return "force" in taken and not is_tried


def _aliased(trials: Trials, *, limit: float = 0.9) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    order = rankdata(trials.index.numpy())
    return any(
        len(value) > 2
        and np.ptp(value) > 0
        and abs(np.corrcoef(order, rankdata(value))[0, 1]) > limit
        for value in trials.action.numpy().T
    )


def _correlation(own: Residuals, *, long: int = 10, least: float = 0.3) -> float:
    """Return that of neighbors in x's first axis; 0 where it is no reason to warn.

    Args:
        own: Residuals, standardized.
        long: Entries a trial of x that may be a trajectory.
        least: Correlation that is one; so are four of its standard errors.
    """
    z = own.refitted
    is_declared = own.times is not None and own.correlation != 0.0
    pairs = np.stack([z[:, :-1].ravel(), z[:, 1:].ravel()])
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    num = pairs.shape[1]
    if is_declared or z.shape[1] < long or num < 3 or not pairs.std(1).all():
        return 0.0
    found = float(np.corrcoef(pairs)[0, 1])
    return found if found > max(least, 4 / np.sqrt(num)) else 0.0


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, float]]:
    """Return effects of the verdict at the edge of their prior, and the largest phi."""
    evidence = tracing.evidences.get(tracing.model)
    found = []
    for effect in effects:
        if effect.name in tracing.chosen and evidence is not None:
            columns = [evidence.names.index(name) for name in effect.phi_names]
            phi = evidence.draws[:, columns].mean(0)
            if _is_extreme(effect, phi):
                found.append((effect, float(phi[np.argmax(np.abs(phi))])))
    return found


def _is_extreme(effect: Effect, mean: Array, *, edge: float = 0.01) -> bool:
    """Return whether phi is further from the null than almost all of its prior."""
    null = effect.null_phi(1).numpy()[0]

    def away(phi: Array) -> Array:  # from an infinite null the far end is away from it
        return np.where(np.isfinite(null), np.abs(phi - null), -np.sign(null) * phi)

    with forked_generators(0, "edge"):
        draws = effect.sample(2_000).numpy()
    return bool(((away(draws) > away(mean)).mean(0) < edge).any())
