"""What a report says of trials that may have a gross error, or that decide alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sbi_active.criticism.results import OUTLIER, Detection, Tracing
from sbi_active.criticism.steps.detection import TOO_SMALL

#: Share of the probability that the suspects hold together.
MASS = 0.9


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
    """Return what a report calls a model: the outlier with its trial."""
    if name != OUTLIER or not tracing.outliers:
        return name
    return f"{name}: {in_words(tracing)}"


def verdict_clause(tracing: Tracing) -> str:
    """Return which trials a verdict is about or rests on, "" for none."""
    line = ""
    if tracing.verdict == OUTLIER:
        line = f": {in_words(tracing)}"
    if tracing.instead_of:
        how = f", which {_rests(tracing)}" if tracing.needed else ""
        return f"{line}, and not {tracing.instead_of}{how}"
    return line + (f", {_rests(tracing)}" if tracing.needed else "")


def of_trials(tracing: Tracing) -> Iterator[str]:
    """Yield what limits a verdict that rests on one trial, a sentence each."""
    if tracing.verdict == OUTLIER:
        which = in_words(tracing)
        yield (
            f"{which} does not agree with the others: check its record, its unit and "
            "its set-up, then correct, withdraw or repeat it; nothing is added for it"
        )
    if tracing.instead_of:
        p = tracing.probabilities.get(tracing.instead_of)
        stated = "" if p is None else f" (probability {p:.2g})"
        why = _why_withdrawn(tracing)
        yield f"{tracing.instead_of}{stated} is not named, since {why}"
    elif len(tracing.needed) == 1:
        yield (
            f"{tracing.verdict} {_rests(tracing)}: without it the Bayes factor "
            "against the bare model is below 20; repeat its action"
        )


def _why_withdrawn(tracing: Tracing) -> str:
    if tracing.refuted:
        before, after = tracing.refuted
        return (
            "it does not lower the error on trials that had no part in it: RMSE "
            f"{before:.3g} before and {after:.3g} after"
        )
    return (
        f"it {_rests(tracing)}, and {in_words(tracing)} may as well have a "
        "gross error: repeat its action before adding it"
    )


def of_noise(detection: Detection | None) -> Iterator[str]:
    """Yield a sentence where residuals are far smaller than the noise allows."""
    if detection is None or detection.lower_p_value > TOO_SMALL:
        return
    least, num = detection.least_chi_square, detection.degrees_of_freedom
    ratio = (least / num) ** 0.5
    yield (
        "residuals are far smaller than the declared noise allows: their root mean "
        f"square is {ratio:.2g} of its standard deviation (chi-square {least:.2g} "
        f"on {num:.1f} degrees of freedom); declare the error of the measurement in "
        "the unit of x, since noise that is too large hides effects and widens the "
        "parameters"
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
