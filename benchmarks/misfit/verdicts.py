"""What a report says, as the scores take it: the one place that knows its layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sbi_active.criticism import Report
from sbi_active.criticism.results import NONE

LEVEL = 0.9  # of intervals


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the loop says of one case.

    Attributes:
        line: The verdict in its words.
        alarm: Whether the bare model is said to miss.
        support: Inclusion probability, nats gained, share of the excess that remains
            and nats of formulas, by effect that helps; empty where a model fits to the
            sensor.
        named: Effects given as a cause.
        helps: Effects said to predict better, those named among them.
        instead: Effects said to be possible in the place of one that helps.
        intervals: Of theta and phi by name, 90 %, given the effects asked for; empty
            where the loop has no such model.
    """

    line: str
    alarm: bool
    support: Mapping[str, tuple[float, float, float, float]]
    named: tuple[str, ...]
    helps: tuple[str, ...]
    instead: Mapping[str, Sequence[str]] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def read_report(report: Report, effects: Sequence[str]) -> Outcome:
    """Return what a report says.

    Where a model fits to the sensor's error, what is named is what helps.

    Args:
        report: Of ``close_loop``.
        effects: Names of those of the model whose intervals are wanted, in the order
            of the library.
    """
    tracing, alarm = report.tracing, bool(report.detection.alarm)
    intervals = {}
    evidence = tracing.evidences.get(" + ".join(effects) or NONE)
    if evidence is not None:
        ends = np.quantile(evidence.draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
        intervals = {
            name: (float(low), float(high))
            for name, low, high in zip(evidence.names, *ends, strict=True)
        }
    misfit = tracing.misfit
    support = {} if misfit is None else misfit.support
    return Outcome(
        line=str(report).splitlines()[0],
        alarm=alarm,
        support={
            name: (own.inclusion, own.gained, own.remains, own.guessed)
            for name, own in support.items()
        },
        named=tracing.chosen if misfit is None else misfit.named,
        helps=tracing.chosen,
        instead={} if misfit is None else misfit.instead,
        intervals=intervals,
    )
