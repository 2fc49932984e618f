"""Simulations on disk.

This package contains the file, its checksums and locks, and the rows in it. It does not
simulate. Names are imported when they are used: a store needs no torch.
"""

from typing import TYPE_CHECKING

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.simulation.bank.bank import Bank
    from sbi_active.simulation.bank.errors import CorruptSegmentError, LockedError

__all__ = ["Bank", "CorruptSegmentError", "LockedError"]

__getattr__ = lazy_names(__name__)
