"""Simulations on disk, and their reuse.

This package contains the file, its checksums and locks, and weights. It does not
simulate. Names are imported when they are used: a store needs no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.simulation.bank.bank import Bank
    from sbi_active.simulation.bank.reweighting import ReusedRows, reuse
    from sbi_active.simulation.bank.store import CorruptSegmentError, LockedError

__all__ = [
    "Bank",
    "CorruptSegmentError",
    "LockedError",
    "ReusedRows",
    "reuse",
]

__getattr__ = lazy_names(
    __name__,
    {
        "bank": "Bank",
        "reweighting": "ReusedRows reuse",
        "store": "CorruptSegmentError LockedError",
    },
)
