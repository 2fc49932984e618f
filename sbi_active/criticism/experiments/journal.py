"""What was predicted and measured, on disk before anything else happens to it."""

from __future__ import annotations

import json
import operator
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from sbi_active.criticism.report.predicted import Registered, TestedTrial

NAME = "trials.jsonl"
#: Fields of a prediction that are arrays.
ARRAYS = ("action", "mean", "sd", "position", "bare")


class Journal:
    """A file of events, one a line: begun, registered, measured, judged.

    Args:
        directory: Folder of the file; None keeps nothing.
    """

    def __init__(self, directory: str | Path | None) -> None:
        self.path = None if directory is None else Path(directory) / NAME
        self.events = [] if self.path is None else _read(self.path)

    def write(self, event: str, **parts: Any) -> None:
        """Add an event; it is on disk when this returns.

        Args:
            event: Name of the event.
            **parts: Numbers, texts and arrays.
        """
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps(
            {"event": event, **parts}, default=operator.methodcaller("tolist")
        )
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())

    def begin(self, **about: Any) -> None:
        """Write what the trials belong to, or compare it with what stands there.

        Args:
            **about: Texts and whole numbers.

        Raises:
            ValueError: If the folder belongs to other trials or another library.
        """
        if not self.events:
            return self.write("begun", **about)
        own = {name: self.events[0].get(name) for name in about}
        if own != about:
            raise ValueError(
                f"expected the trials of {self.path}, {own}; got {about}; pass what "
                "it was begun with, or another directory"
            )
        return None

    def tested(self) -> list[TestedTrial]:
        """Return the trials that were measured, each with its prediction."""
        of: dict[float, dict[str, Any]] = {}
        for event in self.events:
            if "index" in event:
                of.setdefault(event["index"], {})[event["event"]] = event
        return [
            TestedTrial(
                registered=_registered(parts["registered"]),
                x=np.asarray(parts["measured"]["x"], dtype=float),
                after=parts.get("judged", {}).get("verdict", ""),
            )
            for parts in of.values()
            if "measured" in parts
        ]


def _registered(event: dict[str, Any]) -> Registered:
    parts = {f.name: event[f.name] for f in fields(Registered)}
    arrays: dict[str, Any] = {name: np.asarray(parts[name]) for name in ARRAYS}
    return Registered(**{**parts, **arrays})


def _read(path: Path) -> list[dict[str, Any]]:
    """Return the events of a file; a last line that was cut off is none."""
    if not path.exists():
        return []
    whole, _, cut = path.read_text(encoding="utf-8").rpartition("\n")
    if cut:
        path.write_text(f"{whole}\n" if whole else "", encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]
