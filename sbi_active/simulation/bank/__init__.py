"""Simulations on disk, and their reuse.

Here live files, locks, checksums and weights. Nothing here simulates.
"""

from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.damage import CorruptSegmentError
from sbi_active.simulation.bank.lock import LockedError
from sbi_active.simulation.bank.reuse import ReusedRows, reuse
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
