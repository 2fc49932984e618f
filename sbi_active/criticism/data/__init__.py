"""Measured trials, and the tables they are read from.

Here lives what is known before any simulator: numbers, masks, roles and units. Nothing
here simulates.
"""

from sbi_active.criticism.data.arrays import Role
from sbi_active.criticism.data.measurements import Measurements

__all__ = ["Measurements", "Role"]
