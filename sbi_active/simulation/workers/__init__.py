"""The engine: rows of simulations over processes or a cluster.

This package runs rows, handles lost ones and stores them. It does not know what a row
means.
"""

from sbi_active.simulation.workers.pace import Pace, pace_of
from sbi_active.simulation.workers.pickling import pickled
from sbi_active.simulation.workers.pools import DaskPool
from sbi_active.simulation.workers.schedule import Schedule
from sbi_active.simulation.workers.store import Recorder, RowStore, run_digest

__all__ = [
    "DaskPool",
    "Pace",
    "Recorder",
    "RowStore",
    "Schedule",
    "pace_of",
    "pickled",
    "run_digest",
]
