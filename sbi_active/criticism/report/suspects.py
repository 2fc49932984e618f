"""Section of a report on trials that may have a gross error, or decide alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from sbi_active.criticism.contradictions import BoundParameter, Bounds
from sbi_active.criticism.report.numbers import number
from sbi_active.criticism.results import NONE, OUTLIER, Detection, Evaluation, Tracing
from sbi_active.criticism.steps.detection import LEVEL, TOO_SMALL

#: Share of the probability that the suspects hold together.
MASS = 0.9
#: Held-out trials that the verdict's line names at most; the paragraph names all.
MOST_NAMED = 3
#: Which trials refute a verdict.
NO_PART = "trials that had no part in it"


def suspects(tracing: Tracing) -> tuple[float, ...]:
    """Return the indices of trials that hold 90 % of a gross error's probability."""
    found, total = [], 0.0
    for index, share in tracing.outliers.items():  # most probable first
        if total >= MASS:
            break
        found.append(index)
        total += share
    return (*found,)


def in_words(tracing: Tracing) -> str:
    """Return the trials of which one may have a gross error."""
    return (
        _trials(tracing, suspects(tracing), "or") if tracing.outliers else "one trial"
    )


def label(tracing: Tracing, name: str) -> str:
    """Return the name of a model in a report: the outlier with its trial."""
    if name != OUTLIER or not tracing.outliers:
        return name
    return f"{name}: {in_words(tracing)}"


def verdict_clause(tracing: Tracing) -> str:
    """Return the trials that a verdict is about or rests on, "" for none."""
    line = ""
    if tracing.verdict == OUTLIER:
        line = f": {in_words(tracing)}"
    if tracing.instead_of:
        how = f", which {_rests(tracing)}" if tracing.needed else ""
        return f"{line}, and not {tracing.instead_of}{how}"
    return line + (f", {_rests(tracing)}" if tracing.needed else "")


def of_trials(tracing: Tracing) -> Iterator[str]:
    """Yield the limits of a verdict that rests on one trial, a sentence each."""
    if tracing.verdict == OUTLIER:
        which = in_words(tracing)
        yield (
            f"SA521 {which} does not agree with the others: check its record, its "
            "unit and its set-up, then correct, withdraw or repeat it; nothing is "
            "added for it"
        )
    if tracing.instead_of:
        p = tracing.probabilities.get(tracing.instead_of)
        stated = "" if p is None else f" (probability {p:.2g})"
        code, why = _why_withdrawn(tracing)
        yield f"{code} {tracing.instead_of}{stated} is not named, since {why}"
    elif len(tracing.needed) == 1:
        yield (
            f"SA522 {tracing.verdict} {_rests(tracing)}: without it the Bayes factor "
            "against the bare model is below 20; repeat its action"
        )


def _why_withdrawn(tracing: Tracing) -> tuple[str, str]:
    if tracing.bounds.replaces:
        return "SA103", narrow_prior(tracing)
    if tracing.refuted:
        before, after = tracing.refuted
        where = tracing.refuted_on or NO_PART
        return "SA512", (
            f"it does not lower the error on {where}: RMSE {before:.3g} before and "
            f"{after:.3g} after"
        )
    return "SA521", (
        f"it {_rests(tracing)}, and {in_words(tracing)} may as well have a "
        "gross error: repeat its action before adding it"
    )


def narrow_prior(tracing: Tracing) -> str:
    """Return a clause on the wider prior with which the bare model is as good."""
    bounds = tracing.bounds
    where = [place(p) for p in bounds.parameters if p.model == NONE]
    if not where:
        return (
            "no permitted action tells it from the bare model with parameters that its "
            "prior makes improbable, and with a wider prior the model is as good"
        )
    what = "explains the trials as well"
    if bounds.p_value > LEVEL:
        what = "needs no effect"
    return f"{' and '.join(where)}, and with a wider prior the model {what}"


def place(parameter: BoundParameter) -> str:
    """Return at which bound a parameter lies, in words."""
    p = parameter
    return f"{p.name} lies at its prior's {p.side} bound {p.bound:.6g}"


def of_bounds(bounds: Bounds) -> Iterator[str]:
    """Yield the best fit beyond each bound that a parameter is at, a sentence each."""
    for p in bounds.parameters:
        where = "in the bare model" if p.model == NONE else f"with {p.model}"
        beyond = ""
        if not math.isnan(p.beyond):
            beyond = f" with the bound moved the best fit has {p.beyond:.3g};"
        yield (
            f"SA103 {p.name} is at a bound of its prior {where}, the {p.side} one "
            f"({p.bound:.6g});{beyond} move the bound, or say why"
        )


def of_outlying(tracing: Tracing) -> Iterator[str]:
    """Yield a sentence on each trial that was set aside where every model misses."""
    for trial in tracing.set_aside:
        yield (
            f"SA513 trial {trial.name} is far outside what the other trials show: its "
            f"error on the fit to them is {trial.times:.3g} times theirs; it is set "
            "aside, and had no part in the verdict: check its record, its unit and "
            "its set-up, then correct, withdraw or repeat it"
        )


def set_aside_clause(tracing: Tracing) -> str:
    """Return the trials that were set aside, "" for none."""
    which = tracing.set_aside
    if not which:
        return ""
    if len(which) > MOST_NAMED:
        return f"; {len(which)} trials are set aside"
    names = " and ".join(trial.name for trial in which)
    verb = "is" if len(which) == 1 else "are"
    return f"; trial{'s' * (len(which) > 1)} {names} {verb} set aside"


def of_missed(evaluation: Evaluation | None) -> Iterator[str]:
    """Yield a sentence on each held-out trial far outside what is predicted."""
    for trial in () if evaluation is None else evaluation.missed:
        how = f"missed by {number(trial.size)} {trial.unit}"
        if math.isinf(trial.size):
            how = "measured where the model is sure of no measurement"
        yield (
            f"SA514 held-out trial {trial.name} is far outside what the verdict's "
            f"model predicts, {how}: check its record and its unit, or the model is "
            "wrong there"
        )


def missed_clause(evaluation: Evaluation | None) -> str:
    """Return the held-out trials that a verdict misses, "" for none."""
    missed = () if evaluation is None else evaluation.missed
    if not missed:
        return ""
    which = f"{len(missed)} held-out trials are"
    if len(missed) <= MOST_NAMED:
        names = " and ".join(trial.name for trial in missed)
        which = f"held-out trial{'s' * (len(missed) > 1)} {names} "
        which += "is" if len(missed) == 1 else "are"
    return f"; {which} far outside it"


def of_noise(detection: Detection | None) -> Iterator[str]:
    """Yield a sentence where residuals are far smaller than the noise allows."""
    if detection is None or detection.lower_p_value > TOO_SMALL:
        return
    least, num = detection.least_chi_square, detection.degrees_of_freedom
    ratio = (least / num) ** 0.5
    yield (
        "SA523 residuals are far smaller than the declared noise allows: their root "
        f"mean square is {ratio:.2g} of its standard deviation (chi-square "
        f"{least:.2g} on {num:.1f} degrees of freedom); declare the error of the "
        "measurement in the unit of x, since noise that is too large hides effects "
        "and widens the parameters"
    )


def _rests(tracing: Tracing) -> str:
    trials = tracing.needed
    if len(trials) == 1:
        return f"rests on {_trials(tracing, trials, 'and')} alone"
    return f"falls without any one of {_trials(tracing, trials, 'and')}"


def _trials(tracing: Tracing, trials: Sequence[float], last: str) -> str:
    """Return trials of some indices in words."""
    names = [tracing.trial_names.get(index, f"{index:g}") for index in trials]
    if len(names) == 1:
        return f"trial {names[0]}"
    if last == "or":
        return f"trial {', '.join(names[:-1])} or {names[-1]}"
    return f"trials {', '.join(names[:-1])} and {names[-1]}"
