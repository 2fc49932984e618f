"""Measured trials, and the tables they are read from.

This package contains what is known before any simulator: numbers, masks, roles and
units. It does not simulate.
"""

from sbi_active.criticism.data.arrays import Role
from sbi_active.criticism.data.measurements import Measurements

__all__ = ["Measurements", "Role"]
