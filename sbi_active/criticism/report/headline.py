"""Headline of a report: the verdict with its limits, and the findings."""

from __future__ import annotations

from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.numbers import number, stated
from sbi_active.criticism.report.suspects import (
    NO_PART,
    in_words,
    label,
    missed_clause,
    narrow_prior,
    set_aside_clause,
    verdict_clause,
)
from sbi_active.criticism.report.under_misfit import misfit_line, misfit_sentences
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.criticism.under_misfit import UNDECLARED

#: Probability from which a form of a force is named, and one from which it is listed.
CERTAIN, SHOWN = 0.9, 0.01


def verdict_line(report: Contents) -> str:
    """Return the verdict with what limits it, in one line."""
    tracing, verdict = report.tracing, report.verdict
    p = tracing.probabilities.get(verdict) if not tracing.instead_of else None
    line = f"Verdict: {verdict}" + ("" if p is None else f" ({stated(p)})")
    if tracing.misfit is not None and verdict != OUTLIER:
        line = misfit_line(verdict, tracing.misfit)
    elif (family := open_form(report)) is not None:
        line = f"Verdict: {family}"
    likeliest = max(tracing.probabilities, key=tracing.probabilities.__getitem__)
    if verdict == NONE and likeliest != NONE:
        share = stated(tracing.probabilities[likeliest])
        line += f", no alarm, though {likeliest} is likelier ({share})"
    line += _withdrawn_for(tracing) or verdict_clause(tracing)
    bounds = tracing.bounds
    if verdict != NONE and not bounds.replaces and bounds.p_value > LEVEL:
        line += f"; {narrow_prior(tracing)}"
    if tracing.beside and tracing.misfit is None:
        line += f", beside {ModelKey(tracing.beside)}"
    if tracing.stand_in:
        line += f", a stand-in for {UNDECLARED}: {'; '.join(tracing.stand_in)}"
    if report.guess is not None:
        line += f", a guess, not declared: {report.guess}"
    if not tracing.robust:
        line += ", not robust to its prior"
    named = {*tracing.chosen} or {verdict}
    groups = [group for group in tracing.equivalent if group & named]
    same = sorted(frozenset().union(*groups) - named)
    if same:
        line += f"; no permitted action tells it from {', '.join(same)}"
    return line + set_aside_clause(tracing) + missed_clause(report.evaluation)


def _withdrawn_for(tracing: Tracing) -> str:
    """Return the reason not to name effects, "" if only the warnings say it."""
    if tracing.bounds.replaces:
        return f", and not {tracing.instead_of}: {narrow_prior(tracing)}"
    if tracing.misfit is not None and tracing.refuted and tracing.verdict != OUTLIER:
        where = tracing.refuted_on or NO_PART
        return f": {tracing.instead_of} does not lower the error on {where}"
    return ""


def open_form(report: Contents) -> str | None:
    """Return the families of the forces that are chosen where no form is certain."""
    tracing = report.tracing
    families = {e.name: e.family for e in tracing.estimates}
    chosen = {families.get(name, "") for name in tracing.chosen}
    p = tracing.probabilities
    if not chosen or p.get(tracing.verdict, 0.0) >= CERTAIN:
        return None
    if not all(family.startswith((FAMILY, COUPLING)) for family in chosen):
        return None
    shares = {
        key: share
        for key, share in p.items()
        if chosen <= {families.get(name) for name in key.split(" + ")}
    }
    listed = sorted(shares.items(), key=_by_share)
    forms = [f"{n} ({stated(share)})" for n, share in listed if share >= SHOWN]
    cause = " and ".join(sorted(chosen))
    return f"{cause} ({stated(sum(shares.values()))}), form open: {', '.join(forms)}"


def _by_share(item: tuple[str, float]) -> float:
    return -item[1]


def added(report: Contents) -> str:
    """Return the additions to the bare model, in words."""
    tracing, beside = report.tracing, report.tracing.beside
    if tracing.misfit is not None and tracing.chosen:
        return tracing.model
    words = {
        NONE: "nothing",
        UNEXPLAINED: f"{ModelKey(beside)} and " * bool(beside) + "a residual process",
        SCATTER: "larger noise",
        OUTLIER: f"{in_words(report.tracing)} set aside",
    }
    return words.get(report.verdict, report.verdict)


def summary_sentence(report: Contents) -> str:
    """Return the findings, in a few sentences."""
    misfit = report.tracing.misfit
    if misfit is not None and report.verdict != OUTLIER:
        return misfit_sentences(report, misfit)
    detection, trials = report.detection, f"{report.num_trials} trials"
    against = (
        f"log Bayes factor against it {detection.log_bayes_factor:.1f} nats, at least "
        f"{detection.lower:.1f}; {detection.threshold:.1f} raises the alarm"
    )
    if detection.by_chi_square and not detection.by_evidence:
        against += f", and so does its chi-square, p = {detection.p_value:.2g}"
    if report.verdict == NONE:
        return f"The bare model explains the {trials} ({against})."
    found = [f"The bare model misses the {trials} ({against})."]
    if report.tracing.beside:
        most = ModelKey(report.tracing.beside)
        found.append(f"{most} explains most of what it misses, and not all.")
    elif report.verdict == UNEXPLAINED and not report.tracing.bounds.replaces:
        found.append("No declared effect explains what it misses.")
    elif report.verdict == SCATTER:
        found.append(
            "They scatter more than the declared noise, and no declared effect "
            "explains it."
        )
    elif report.verdict == OUTLIER:
        which = in_words(report.tracing)
        found.append(
            f"{which[0].upper()}{which[1:]} does not agree with the others: check it, "
            "and correct, withdraw or repeat it."
        )
    others = [n for n in report.credible_set if n != report.verdict]
    if others:
        shares = [
            f"{label(report.tracing, n)} ({stated(report.probabilities[n])})"
            for n in others
        ]
        found.append(f"Not excluded: {', '.join(shares)}.")
    found += [
        f"{e.name}: {e.describe.rstrip('.')}."
        for e in report.tracing.estimates
        if e.name in report.tracing.chosen and e.describe
    ]
    if report.evaluation is not None:
        rows = report.before_after.set_index("metric").to_dict("index")
        rmse = rows["rmse"]
        tracing = report.tracing
        folds = tracing.refuted or tracing.bounds.replaces
        folds = folds and report.evaluation.scheme != "held out"
        model = tracing.instead_of if folds else added(report)
        sentence = (
            f"With {model}, the RMSE on trials that had no part in it goes "
            f"from {number(rmse['before'])} to {number(rmse['after'])}"
        )
        if rmse["interval"] is not None:
            low, high = map(number, rmse["interval"])
            sentence += (
                f" (ratio {number(rmse['ratio'])}, 90 % interval {low} to {high})"
            )
        found.append(f"{sentence}.")
    return " ".join(found)
