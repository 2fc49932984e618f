"""``sbi-active gate DIR``: whether a simulator may be used, as an exit status."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sbi_active.cli.criticize import criticize
from sbi_active.cli.output import Answer


def gate(trials: Path, **given: Any) -> Answer | None:
    """Return the decision on the simulator that trials are compared with.

    Args:
        trials: Table of trials, folder of recordings, or campaign.
        **given: Options of ``criticize`` by name.
    """
    answer = criticize(trials, **given)
    if answer is None:  # a program asked, and was answered
        return None
    found = answer.data["gate"]
    text = f"{found['decision']}: {found['reason']}"
    return Answer(found, text, found["exit_code"])
