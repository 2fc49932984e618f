"""Folders of earlier releases, brought up to date once.

Here live the readers of what earlier releases wrote: folders of HDF5 and logs of JSON
lines. Nothing here is used by a campaign or a bank of today.
"""

from sbi_active.migration.folders import migrate

__all__ = ["migrate"]
