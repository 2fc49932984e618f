"""What is wrong in a table of trials, and where."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.table_rows import Rows

__all__ = [
    "note_empty",
    "note_scales",
    "require_constant",
    "require_distinct",
    "require_distinct_trials",
    "require_order",
]

Array = NDArray[Any]

#: Decades between the sizes of two groups of trials that look like two units, and those
#: within each.
GAP, WITHIN = 1.7, 1.0
SHOWN = 5  # places that a message lists


def require_constant(
    values: Array, column: str, members: list[Array], rows: Rows
) -> None:
    """Raise where a column varies within a trial."""
    for at in members:
        for i in at[values[at] != values[at[0]]]:
            raise ValueError(
                f"expected one value of {column} in each trial; got {values[at[0]]} in "
                f"row {at[0] + 1} and {values[i]} in {rows.place(int(i))} of "
                f"{rows.source}; do give each trial its own name, or x_* to what varies"
            )


def require_order(time: Array, members: list[Array], rows: Rows) -> None:
    """Raise where a sample is there twice, or time runs backward in a trial."""
    for at in members:
        stamps, own = time[at], rows.columns.time
        order = np.argsort(stamps, kind="stable")
        for k in np.flatnonzero(np.diff(stamps[order]) == 0):
            one, two = sorted((at[order[k]], at[order[k + 1]]))
            raise ValueError(
                f"expected each sample once; got {own} = {stamps[order[k]]:g} s in "
                f"rows {one + 1} and {two + 1} of {rows.source}, both of trial "
                f"{(rows.trial or [])[one]}; do remove one, or give each trial its own "
                "name"
            )
        for k in np.flatnonzero(np.diff(stamps) < 0):
            raise ValueError(
                f"expected times that increase within a trial; got {stamps[k + 1]:g} s "
                f"in {rows.place(int(at[k + 1]))} after {stamps[k]:g} s in row "
                f"{at[k] + 1} of {rows.source}; do sort its rows, or give each trial "
                "its own name"
            )


def require_distinct_trials(
    samples: list[Array], action: Array, names: list[str], rows: Rows
) -> None:
    """Raise where two trials are the same number for number."""
    seen: dict[bytes, int] = {}
    for t, own in enumerate(samples):
        if not np.isfinite(own[:, 1:]).any():
            continue  # repeated trials without any measurement are alike
        key = np.concatenate([action[t], own.ravel()]).tobytes()
        if key in seen:
            raise ValueError(
                f"expected each trial once; got the same numbers in trials "
                f"{names[seen[key]]} and {names[t]} of {rows.source}; do remove one"
            )
        seen[key] = t


def require_distinct(
    values: Array, name: str | None, rows: Rows, first: Array | None = None
) -> None:
    """Raise where two trials have the same values, shape (n, k).

    Args:
        values: That no two trials share.
        name: What they are; None for all numbers of a trial.
        rows: Of the table.
        first: Row of each trial, shape (n,); None where a row is a trial.
    """
    seen: dict[tuple[float, ...], int] = {}
    for i, row in enumerate(values):
        # Repeated trials without any measurement are alike, and yet two trials.
        key = tuple(row) if np.isfinite(row).all() else (*row, i)
        if key in seen:
            what = f"{name} {row[0]:g}" if name else "the same numbers"
            one, two = (k if first is None else int(first[k]) for k in (seen[key], i))
            raise ValueError(
                f"expected each trial once; got {what} in rows {one + 1} and {two + 1} "
                f"of {rows.source}; do remove one, or give each its own index where "
                "both were executed"
            )
        seen[key] = i


def note_empty(x: Array, rows: Rows) -> None:
    """Warn of what counts as not measured."""
    for j, column in enumerate(rows.columns.x):
        at = np.flatnonzero(np.isnan(x[:, j]))
        if len(at):
            some = ", ".join(rows.place(int(i)) for i in at[:SHOWN])
            more = f" and {len(at) - SHOWN} more" if len(at) > SHOWN else ""
            warnings.warn(
                f"{len(at)} of {len(x)} cells of column {column} in {rows.source} hold "
                f"no number: {some}{more}; they count as not measured",
                stacklevel=5,
            )


def note_scales(
    sizes: Sequence[Array] | Array, names: list[str], column: str, rows: Rows
) -> None:
    """Warn where some trials' numbers are as much larger as another unit makes them."""
    typical = np.array([np.nanmedian(s) if np.isfinite(s).any() else 0 for s in sizes])
    some = np.flatnonzero(typical > 0)
    if len(some) < 3:
        return
    decades = np.log10(typical[some])
    order = np.argsort(decades)
    gaps = np.diff(decades[order])
    k = int(np.argmax(gaps))
    low, high = decades[order[: k + 1]], decades[order[k + 1 :]]
    if gaps[k] < GAP or max(np.ptp(low), np.ptp(high)) > WITHIN:
        return
    fewer, word = (
        (order[: k + 1], "smaller")
        if len(low) < len(high)
        else (
            order[k + 1 :],
            "larger",
        )
    )
    which = ", ".join(names[some[i]] for i in sorted(fewer)[:SHOWN])
    factor = 10 ** abs(np.median(high) - np.median(low))
    warnings.warn(
        f"{column} of {'rows' if not rows.columns.trial else 'trials'} {which} in "
        f"{rows.source} is about {factor:.0f} times {word} than that of the others: do "
        "check that all are in one unit",
        stacklevel=5,
    )
