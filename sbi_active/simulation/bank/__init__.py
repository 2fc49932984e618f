"""Simulations on disk, and their reuse.

This package contains the file, its checksums and locks, and weights. It does not
simulate. Names are imported when they are used: a store needs no torch.
"""

from sbi_active.renamed import lazy_names

HOMES = {"bank": "Bank", "reweighting": "ReusedRows reuse"}
HOMES["errors"] = "CorruptSegmentError LockedError"

__getattr__ = lazy_names(__name__, HOMES)
