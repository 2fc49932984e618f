"""A tracker that keeps nothing, so that training leaves no folder behind."""

from __future__ import annotations

from typing import Any

__all__ = ["SilentTracker"]


class SilentTracker:
    """Meets sbi's ``Tracker`` protocol and does nothing."""

    @property
    def log_dir(self) -> str | None:
        """None: there is no folder."""
        return None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None:
        """Ignore one figure."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Ignore several figures."""

    def log_params(self, params: dict[str, Any]) -> None:
        """Ignore parameters."""

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None:
        """Ignore a figure."""

    def flush(self) -> None:
        """Do nothing."""
