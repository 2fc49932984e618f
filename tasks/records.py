"""Records of one input and one output at a constant rate, whole or in pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.criticism import Trials

__all__ = ["Pieces", "Record", "cut", "read_record"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Record:
    """One record.

    Attributes:
        name: Of its file.
        step: Between samples, s.
        voltage: The input, held from each sample to the next, shape (m,).
        output: What the sensor read, shape (m,).
    """

    name: str
    step: float
    voltage: Array
    output: Array

    def __len__(self) -> int:
        return len(self.output)

    def part(self, first: int, last: int | None = None) -> Record:
        """Return the samples from ``first`` to before ``last``."""
        rows = slice(first, last)
        return Record(self.name, self.step, self.voltage[rows], self.output[rows])


@dataclass(frozen=True)
class Pieces:
    """A record cut into trials of one length, each with the start that was read.

    The last reading of a piece is at the time of the first of the next one. A piece may
    run for a while before its first reading, so that its start is forgotten.

    Attributes:
        step: Of the input, s.
        begin: Of each piece in its record, s, shape (t,).
        start: First output of each, shape (t,).
        voltage: Shape (t, m), at the times 0, step, ...
        times: Of the outputs after the first, s from the beginning of a piece, (k,).
        output: At these times, shape (t, k).
        slope: Of the output at the start, per s, shape (t,); None where nobody asks.
    """

    step: float
    begin: Array
    start: Array
    voltage: Array
    times: Array
    output: Array
    slope: Array | None = None

    def __len__(self) -> int:
        return len(self.begin)

    @property
    def action(self) -> Tensor:
        """Begin in s, first output and its slope if there, (t, 2 or 3), float64."""
        parts = [self.begin, self.start]
        parts += [] if self.slope is None else [self.slope]
        return torch.from_numpy(np.column_stack(parts))

    @property
    def inputs(self) -> dict[str, Tensor]:
        """The voltage by its name, shape (t, m)."""
        return {"voltage": torch.from_numpy(self.voltage)}

    @property
    def input_times(self) -> Tensor:
        """Of the voltage, shape (m,)."""
        return self.step * torch.arange(self.voltage.shape[1], dtype=torch.float64)

    def rows(self, num: int) -> dict[str, Any]:
        """Return action, inputs and times of every piece, repeated ``num`` times."""
        return {
            "action": self.action.repeat(num, 1),
            "inputs": {k: v.repeat(num, 1) for k, v in self.inputs.items()},
            "times": torch.from_numpy(self.times).repeat(num * len(self), 1),
        }

    def trials(self, labels: Sequence[str], channel: str | None = None) -> Trials:
        """Return the pieces as trials with their inputs over time.

        Args:
            labels: What reports call the numbers of an action.
            channel: What they call the output, with its unit.
        """
        return Trials(
            self.action,
            self.output,
            sample_times=self.times,
            action_labels=labels,
            channel_labels=None if channel is None else [channel],
            inputs=self.inputs,
            input_times=self.input_times,
        )


def cut(
    record: Record, length: int, *, every: int = 1, slope: int = 0, lead: int = 0
) -> Pieces:
    """Cut a record into as many whole pieces as it has.

    Args:
        record: The record.
        length: Of a piece, steps of the input.
        every: Keep each so many-th output.
        slope: First samples of a piece through which a line gives its slope; 0 for
            none.
        lead: Steps that a piece runs before its readings begin to count.

    Raises:
        ValueError: If the record is shorter than a piece, or ``every`` does not divide
            the length.
    """
    # The last sample of all has no next one: a record of whole pieces lacks it.
    num = (len(record) - lead) // length
    if num <= 0 or length % every:
        raise ValueError(
            f"expected pieces of at most {len(record)} samples, a multiple of {every}; "
            f"got {length}; change length or every"
        )
    first = np.arange(num) * length
    kept = lead + np.arange(every, length + 1, every)
    at = first[:, None] + kept
    output = np.where(
        at < len(record), record.output[np.minimum(at, len(record) - 1)], np.nan
    )
    steep = None
    if slope:
        line = record.step * (np.arange(slope) - (slope - 1) / 2)
        near = record.output[first[:, None] + np.arange(slope)]
        steep = near @ line / (line @ line)
    return Pieces(
        record.step,
        first * record.step,
        record.output[first],
        record.voltage[first[:, None] + np.arange(lead + length)],
        kept * record.step,
        output,
        steep,
    )


def read_record(path: str | Path, *, voltage: str, output: str) -> Record:
    """Return the record in a CSV file.

    Args:
        path: With a column ``time_s`` and those named below.
        voltage: Column of the input.
        output: Column of the output.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a column is missing, a number is not finite, or the rate is not
            constant.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"expected a record in {path}; got no such file; give the folder that "
            "holds it"
        )
    table = pd.read_csv(path)
    columns = ("time_s", voltage, output)
    missing = [c for c in columns if c not in table.columns]
    if missing:
        raise ValueError(
            f"expected columns {', '.join(columns)} in {path.name}; got no "
            f"{', '.join(missing)}; rename or add them"
        )
    time, u, y = (table[c].to_numpy(dtype=np.float64) for c in columns)
    for name, values in zip(columns, (time, u, y), strict=True):
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise ValueError(
                f"expected finite {name} in {path.name}; got {values[row]} in sample "
                f"{row}; remove the record from there on"
            )
    steps = np.diff(time)
    if len(steps) == 0 or np.ptp(steps) > 1e-3 * abs(steps[0]) or steps[0] <= 0:
        raise ValueError(
            f"expected a constant rate in {path.name}; got steps from "
            f"{steps.min() if len(steps) else 0:g} to "
            f"{steps.max() if len(steps) else 0:g} s; resample the record"
        )
    return Record(path.stem, float(steps.mean()), u, y)
