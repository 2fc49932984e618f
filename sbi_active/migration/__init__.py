"""Folders of earlier releases, brought up to date once.

This package contains the readers of files that earlier releases wrote: folders of HDF5
and logs of JSON lines. Current campaigns and banks do not use it.
"""

from sbi_active.migration.folders import migrate

__all__ = ["migrate"]
