"""The records of the tanks: one to fit, in pieces or whole, and one to score."""

from __future__ import annotations

from pathlib import Path

from sbi_active.tasks.records import Pieces, Record, cut, read_record

__all__ = ["DATA", "FOUND_ON", "read_recordings", "split"]

DATA = Path("../shared/data/cascaded_tanks")
FILES = ("estimation", "validation")
#: Samples of a piece: 512 s, some time constants of the tanks, so that what a piece
#: tells beyond its unknown start levels is most of it; eight pieces can be left out.
LENGTH = 128
EVERY = 4  # keep one reading in 16 s
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


def split(
    records: dict[str, Record], *, length: int = LENGTH, every: int = EVERY
) -> tuple[Pieces, Pieces]:
    """Return the pieces to fit, and the scored record in one piece.

    Args:
        records: Of :func:`read_recordings`.
        length: Samples of a piece to fit.
        every: Readings of the fitted pieces that are kept; the scored ones are all.
    """
    fitted, scored = (records[name] for name in FILES)
    return cut(fitted, length, every=every), cut(scored, len(scored) - 1)
