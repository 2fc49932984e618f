"""What a report says first: the verdict with what limits it, and what was found."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.suspects import in_words, label, verdict_clause
from sbi_active.criticism.results import NONE, OUTLIER, SCATTER, UNEXPLAINED, ModelKey

#: Digits of a number that any deviation leaves.
MOST_DIGITS = 6


def verdict_line(report: Contents) -> str:
    """Return the verdict with what limits it, in one line."""
    tracing, verdict = report.tracing, report.verdict
    p = tracing.probabilities.get(verdict)
    line = f"Verdict: {verdict}" + ("" if p is None else f" ({stated(p)})")
    line += verdict_clause(tracing)
    if tracing.beside:
        line += f", beside {ModelKey(tracing.beside)}"
    if report.guess is not None:
        line += f", a guess, not declared: {report.guess}"
    if not tracing.robust:
        line += ", not robust to its prior"
    named = {*tracing.chosen} or {verdict}
    groups = [group for group in tracing.equivalent if group & named]
    same = sorted(frozenset().union(*groups) - named)
    if same:
        line += f"; no permitted action tells it from {', '.join(same)}"
    return line


def added(report: Contents) -> str:
    """Return what was added to the bare model, in words."""
    beside = report.tracing.beside
    words = {
        NONE: "nothing",
        UNEXPLAINED: f"{ModelKey(beside)} and " * bool(beside) + "a residual process",
        SCATTER: "larger noise",
        OUTLIER: f"{in_words(report.tracing)} set aside",
    }
    return words.get(report.verdict, report.verdict)


def summary_sentence(report: Contents) -> str:
    """Return what was found, in a few sentences."""
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
    elif report.verdict == UNEXPLAINED:
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
        folds = report.tracing.refuted and report.evaluation.scheme != "held out"
        model = report.tracing.instead_of if folds else added(report)
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


def with_error(mean: float, sd: float) -> str:
    """Return a mean to the second digit of its deviation; nothing for NaN.

    Of a mean that is known better than that, six digits are enough.

    Example:
        >>> with_error(0.35992, 0.00071), with_error(1234.5, 56.7)
        ('0.35992 +- 0.00071', '1234 +- 57')
        >>> with_error(159.873313255, 2.8e-14)
        '159.873 +- 2.8e-14'
    """
    if np.isnan(mean):
        return ""
    size = abs(mean) + sd
    if not (sd > 0 and 1e-4 <= size < 1e6):  # powers of ten, or no deviation
        return f"{mean:.4g} +- {sd:.2g}"
    exponent = int(f"{sd:.1e}".split("e")[1])  # after rounding to two digits
    places = max(1 - exponent, 0)
    most = max(MOST_DIGITS - int(f"{mean:.{MOST_DIGITS - 1}e}".split("e")[1]) - 1, 0)
    if places > most:
        return f"{mean:.{most}f} +- {sd:.2g}"
    return f"{mean:.{places}f} +- {sd:.{places}f}"
