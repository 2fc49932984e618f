"""A tracker that keeps nothing, so that training leaves no folder behind."""

from __future__ import annotations

from typing import Any


class SilentTracker:
    """Meets sbi's ``Tracker`` protocol and does nothing."""

    log_dir: str | None = None

    def _ignore(self, *args: Any, **kwargs: Any) -> None:
        pass

    log_metric = log_metrics = log_params = add_figure = flush = _ignore
