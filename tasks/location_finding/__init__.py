"""Hidden sources located by the strength of their signal."""

from sbi_active.tasks.location_finding.task import LocationFindingTask

__all__ = ["LocationFindingTask"]
