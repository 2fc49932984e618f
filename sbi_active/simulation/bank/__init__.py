"""Simulations on disk, and their reuse.

Here live files, locks, checksums and weights. Nothing here simulates. A name is
imported when it is used: files and locks need no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbi_active.renamed import former_names, lazy_names

if TYPE_CHECKING:
    from sbi_active.simulation.bank.bank import Bank
    from sbi_active.simulation.bank.damage import CorruptSegmentError
    from sbi_active.simulation.bank.lock import LockedError
    from sbi_active.simulation.bank.reweighting import ReusedRows, reuse
    from sbi_active.simulation.bank.segments import read_segment, write_segment

__all__ = [
    "Bank",
    "CorruptSegmentError",
    "LockedError",
    "ReusedRows",
    "read_segment",
    "reuse",
    "write_segment",
]

__getattr__ = lazy_names(
    __name__,
    {
        "bank": "Bank",
        "damage": "CorruptSegmentError",
        "lock": "LockedError",
        "reweighting": "ReusedRows reuse",
        "segments": "read_segment write_segment",
    },
    former_names(__name__, {}, stacklevel=3),
)
