"""Simulations on disk.

This package contains the file, its checksums and locks, and the rows in it. It does not
simulate. A store needs no torch.
"""

from sbi_active.simulation.bank.store import CorruptSegmentError, LockedError

__all__ = ["CorruptSegmentError", "LockedError"]
