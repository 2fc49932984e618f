"""Conditions of a named verdict, and the actions that would test it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.headline import summary_sentence
from sbi_active.criticism.report.names import named_entries, setting
from sbi_active.criticism.report.numbers import number
from sbi_active.criticism.report.suspects import of_bounds, of_missed, of_outlying

#: Parameters and entries of the action that a sentence names at most.
MOST_NAMED = 3


def first_paragraph(report: Contents) -> str:
    """Return the findings, and the conditions of a verdict that names effects."""
    tracing = report.tracing
    against = [*of_outlying(tracing), *of_missed(report.evaluation)]
    against += of_bounds(tracing.bounds)
    texts = [text.partition(" ")[2] for text in against]  # without their codes
    said = [f"{text[0].upper()}{text[1:]}." for text in texts]
    return " ".join([summary_sentence(report), *said, *conditions(report)])


def conditions(report: Contents) -> Iterator[str]:
    """Yield the conditions of a verdict that names effects, a sentence each.

    An effect that was not declared can pass for declared ones, with parameters that are
    wrong and residuals that are as small. The data at hand cannot tell.
    """
    if not report.tracing.chosen:
        return
    yield (
        "P holds among the declared effects alone: an effect that nobody declared may "
        "pass for them."
    )
    yield _moved(report)
    yield _tried(report)
    if report.severe_tests:
        tests = ", and ".join(_tests(report))
        yield f"The verdict would be put to the test most {tests}."


def _tests(report: Contents) -> Iterator[str]:
    """Yield each severe test, with how far a free residual's prediction is there."""
    between = "where its prediction and that of a free residual differ by "
    unit = " of its standard deviations"
    for test in report.severe_tests:
        where = "at " if test.is_permitted else "beyond the permitted range at "
        action = setting(report.action_labels, test.action)
        yield f"{where}{action}, {between}{number(test.difference)}{unit}"
        between, unit = "by ", ""


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
        f"{number(table['after'].iloc[i])} ({_times(float(far[i]))})"
        for i in order[:MOST_NAMED]
    ]
    rest = len(order) - len(moves)
    more = f", and {rest} more by at least one" if rest else ""
    return f"Against the bare fit the verdict moves {', '.join(moves)}{more}."


def _times(far: float) -> str:
    many = "more than 1000" if far > 1_000 else f"{far:.2g}"
    return f"{many} of its standard deviations"


def _tried(report: Contents) -> str:
    """Return the actions that were executed."""
    if report.action_is_label:
        return "No other inputs were tried than those of these trials."
    action = np.unique(report.residuals.action, axis=0)
    if len(action) == 1:
        only = setting(report.action_labels, action[0])
        return f"No other action was tried than {only}."
    entries = [*zip(named_entries(report.action_labels), action.T, strict=True)]
    ranges = [
        f"{name} from {column.min():.4g} to {column.max():.4g} {unit}".rstrip()
        for (name, unit), column in entries[:MOST_NAMED]
    ]
    rest = len(entries) - len(ranges)
    more = f", and {rest} more entries" if rest else ""
    tried = ", ".join(ranges) + more
    return f"No other action was tried than these {len(action)}: {tried}."
