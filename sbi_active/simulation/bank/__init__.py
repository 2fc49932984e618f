"""Simulations on disk, and their reuse.

Here live the file, its checksums and locks, and weights. Nothing here simulates.
"""

from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.damage import CorruptSegmentError, LockedError
from sbi_active.simulation.bank.reuse import ReusedRows, reuse

__all__ = [
    "Bank",
    "CorruptSegmentError",
    "LockedError",
    "ReusedRows",
    "reuse",
]
