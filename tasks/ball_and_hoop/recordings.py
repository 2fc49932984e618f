"""The records of the hoop: which are fitted, which are held out, and in what pieces."""

from __future__ import annotations

from pathlib import Path

from sbi_active.tasks.records import Pieces, Record, cut, read_record

__all__ = ["DATA", "read_recordings", "split"]

DATA = Path("../shared/data/ball_and_hoop")
FILES = ("random_steps", "fixed_steps", "closed_loop")
FITTED = 3_000  # first samples of random_steps
#: Samples of a piece: 30 s, twenty times the hoop's time constant, so that a start
#: which is read once a piece tells next to nothing of the rest, and the ten pieces are
#: trials of their own. The speed is read, and to .01 V, so that the start needs no
#: nuisance; one long record would be a single trial, which nothing could be left out
#: of.
LENGTH = 300
#: Keep one reading a second of ten: what a model of the hoop gets wrong lasts seconds.
EVERY = 10


def read_recordings(directory: str | Path = DATA) -> dict[str, Record]:
    """Return the three records by name.

    Args:
        directory: Holds ``random_steps.csv``, ``fixed_steps.csv`` and
            ``closed_loop.csv`` (time_s, input_V, output_V).
    """
    return {
        name: read_record(
            Path(directory) / f"{name}.csv", voltage="input_V", output="output_V"
        )
        for name in FILES
    }


def split(
    records: dict[str, Record], *, every: int = EVERY
) -> tuple[Pieces, dict[str, Pieces]]:
    """Return the pieces to fit, and each held-out record in one piece.

    Args:
        records: Of :func:`read_recordings`.
        every: Readings of the fitted pieces that are kept; held-out ones are all.
    """
    first, *others = (records[name] for name in FILES)
    held = [first.part(FITTED), *others]
    return (
        cut(first.part(0, FITTED + 1), LENGTH, every=every),
        {record.name: cut(record, len(record) - 1) for record in held},
    )
