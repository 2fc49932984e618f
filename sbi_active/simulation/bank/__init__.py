"""Simulations on disk, and their reuse.

This package contains the file, its checksums and locks, and weights. It does not
simulate. Names are imported when they are used: a store needs no torch.
"""

from typing import TYPE_CHECKING

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.simulation.bank.bank import Bank
    from sbi_active.simulation.bank.errors import CorruptSegmentError, LockedError
    from sbi_active.simulation.bank.reweighting import ReusedRows, reuse

__all__ = ["Bank", "CorruptSegmentError", "LockedError", "ReusedRows", "reuse"]

__getattr__ = lazy_names(__name__)
