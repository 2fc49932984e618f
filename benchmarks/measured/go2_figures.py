"""The figure of a leg: its residuals before and after, and the friction found."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

from benchmarks.measured.go2_leg import JOINTS, Leg, usual_parameters
from sbi_active.mujoco import mjcf_effects


def draw(row: Mapping[str, Any], leg: Leg, folder: Path) -> Path:
    """Draw one free run of the record, and its residuals.

    Args:
        row: Of ``judge``, from the engineer's model.
        leg: Whose record it is.
        folder: Where ``LEG.png`` goes.
    """
    parameters = usual_parameters(leg)
    robot = leg.robot(parameters, leg.triangles())
    helps = row["helps"]
    effects = {e.name: e for e in mjcf_effects(robot, include=helps)} if helps else {}
    given = [effects[name] for name in helps]
    runs = {
        "before": leg.free_run(parameters, [], torch.tensor([row["bare values"]])),
        "after": leg.free_run(parameters, given, torch.tensor([row["values"]])),
    }
    figure, axes = plt.subplots(4, 1, figsize=(9, 7.5), sharex=True)
    knee = len(JOINTS) - 1
    top = axes[0]
    top.plot(leg.time, leg.goal[:, knee], color="0.7", lw=0.8, label="goal")
    top.plot(leg.time, leg.position[:, knee], "k", lw=0.8, label="measured")
    colors = {"before": "tab:red", "after": "tab:blue"}
    for when, x in runs.items():
        top.plot(leg.time, x[0, :, knee], color=colors[when], lw=0.8, label=when)
        for k, axis in enumerate(axes[1:]):
            left = 1e3 * (leg.position[:, k] - x[0, :, k])
            rms = 1e3 * np.array(row[when]["held out"][k])
            label = f"{when}, held out {rms:.1f} mrad"
            axis.plot(leg.time, left, color=colors[when], lw=0.7, label=label)
            axis.set_ylabel(f"{JOINTS[k]} residual [mrad]", fontsize=8)
    top.set_ylabel("knee [rad]", fontsize=8)
    for axis in axes:
        axis.axvspan(leg.time[leg.split], leg.time[-1], color="0.93", zorder=0)
        axis.legend(fontsize=7, frameon=False, loc="upper left", ncol=4)
        axis.set_xlim(0, leg.time[-1])
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    axes[-1].set_xlabel("time [s]")
    top.set_title(f"{leg.name}: one free run; grey: held out", fontsize=9)
    figure.tight_layout()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{leg.name}.png"
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path
