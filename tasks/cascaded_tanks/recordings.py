"""The records of the tanks: one to fit, in pieces or whole, and one to score."""

from __future__ import annotations

from pathlib import Path

from sbi_active.tasks.records import Pieces, Record, cut, read_record

__all__ = ["DATA", "FOUND_ON", "SLOPE", "read_recordings", "split"]

DATA = Path("../shared/data/cascaded_tanks")
FILES = ("estimation", "validation")
#: Samples of a piece, 600 s, and of what runs before its readings count, 400 s or four
#: time constants: start levels, of which the upper one is never read, are forgotten by
#: then and need no nuisance. A trial that is left out would have to be predicted from
#: start levels that nobody knows, and their error hides all others.
LENGTH, LEAD = 150, 100
EVERY = 5  # keep one reading in 20 s
SLOPE = 6  # first samples, 20 s, whose slope tells of the upper tank
FOUND_ON = 50  # first samples of the scored record, on which its start is found


def read_recordings(directory: str | Path = DATA) -> dict[str, Record]:
    """Return both records by name.

    Args:
        directory: Holds ``estimation.csv`` and ``validation.csv`` (time_s, pump_V,
            level_V).
    """
    return {
        name: read_record(
            Path(directory) / f"{name}.csv", voltage="pump_V", output="level_V"
        )
        for name in FILES
    }


def split(records: dict[str, Record], *, every: int = EVERY) -> tuple[Pieces, Pieces]:
    """Return the six pieces to fit, and the scored record in one piece.

    Args:
        records: Of :func:`read_recordings`.
        every: Readings of the fitted pieces that are kept; the scored ones are all.
    """
    fitted, scored = (records[name] for name in FILES)
    whole = cut(scored, len(scored) - 1, slope=SLOPE)
    return cut(fitted, LENGTH, every=every, slope=SLOPE, lead=LEAD), whole
