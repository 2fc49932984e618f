"""The figure of the servo pendulum: held-out trials before and after."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from sbi_active.tasks.servo_pendulum import Recordings  # pyright: ignore

__all__ = ["draw"]


def draw(
    rows: Mapping[str, dict[str, Any]], recordings: Recordings, folder: Path
) -> Path:
    """Draw the held-out trials and their residuals.

    Args:
        rows: By stage, of ``judge``.
        recordings: The measured trials.
        folder: Where ``measured_servo.png`` goes.
    """
    row = rows["motor off"]
    held = row["held_out"]
    figure, axes = plt.subplots(
        2, len(held), figsize=(3.4 * len(held), 4.2), sharex=True, sharey="row"
    )
    for j, trial in enumerate(held):
        angle, times = recordings.angle[trial], recordings.times
        top, bottom = axes[:, j]
        top.plot(times, angle, "k.", ms=4, label="measured")
        for when, color in (("before", "tab:red"), ("after", "tab:blue")):
            mean = np.array(row["draws"][when]["mean"][j])
            what = "bare model" if when == "before" else "after"
            top.plot(times, mean, color=color, lw=1, label=what)
            bottom.plot(times, angle - mean, color=color, lw=1)
        bottom.axhline(0.0, color="k", lw=0.5)
        top.set_title(
            f"{recordings.trajectory[trial]}, kp {recordings.kp[trial]:.0f}", fontsize=9
        )
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("angle [rad]")
    axes[1, 0].set_ylabel("residual [rad]")
    axes[0, 0].legend(fontsize=7, frameon=False)
    figure.tight_layout()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "measured_servo.png"
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path
