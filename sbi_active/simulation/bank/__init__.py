"""Simulations on disk.

This package contains the file, its checksums and locks, and the rows in it. It does not
simulate. Names are imported when they are used: a store needs no torch.
"""

from sbi_active.renamed import lazy_names

HOMES = {"bank": "Bank", "errors": "CorruptSegmentError LockedError"}
FORMER = {n: f"sbi_active.simulation.reweighting:{n}" for n in ("ReusedRows", "reuse")}

__getattr__ = lazy_names(__name__, HOMES, FORMER)
