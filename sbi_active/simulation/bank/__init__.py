"""Simulations on disk, and their reuse."""

from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.damage import CorruptSegmentError
from sbi_active.simulation.bank.lock import LockedError
from sbi_active.simulation.bank.reuse import ReusedRows, reuse

__all__ = ["Bank", "CorruptSegmentError", "LockedError", "ReusedRows", "reuse"]
