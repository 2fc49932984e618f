"""Measured trials, and the tables they are read from.

Here lives what is known before any simulator: numbers, masks, roles and units. Nothing
here simulates.
"""

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Role

__all__ = ["Measurements", "Role"]
