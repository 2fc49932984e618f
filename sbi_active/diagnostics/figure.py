"""Figures of a calibration check, in sbi's style."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from sbi.analysis.plot import sbc_rank_plot

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_calibration(found: Any) -> Figure:
    """Draw ranks, TARP, and coverage and gap of each stratum with their intervals.

    Args:
        found: A :class:`.Calibration`.
    """
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    figure.suptitle(f"calibration: {found.verdict}")
    for k in range(len(found.parameter_names)):
        sbc_rank_plot(
            found.ranks[:, k : k + 1],
            found.num_posterior_samples,
            plot_type="cdf",
            ranks_labels=[found.parameter_names[k]],
            colors=[f"C{k}"],
            fig=figure,
            ax=axes[0, 0],
        )
    axes[0, 0].set_title("ranks of the truth")
    coverage, credibility = found.tarp
    axes[0, 1].plot(credibility, coverage, color="blue", label="TARP")
    levels = [*found.overall.coverage]
    middle = [found.overall.coverage[c] for c in levels]
    ends = np.array([found.overall.coverage_interval[c] for c in levels]).T
    axes[0, 1].errorbar(
        levels, middle, abs(ends - middle), fmt="o", label="smallest regions"
    )
    axes[0, 1].plot([0, 1], [0, 1], "k--", label="ideal")
    axes[0, 1].set(xlabel="credibility level", ylabel="expected coverage")
    axes[0, 1].legend()
    place = np.arange(len(found.strata))
    color = {"trust": "C2", "refine": "C1", "stop": "C3"}
    for i, s in zip(place, found.strata, strict=True):
        for ax, value, (low, high) in (
            (axes[1, 0], s.coverage[0.9], s.coverage_interval[0.9]),
            (axes[1, 1], s.gap, s.gap_interval),
        ):
            error = [[max(value - low, 0)], [max(high - value, 0)]]
            ax.errorbar(i, value, error, fmt="o", color=color[s.verdict])
    axes[1, 0].axhline(0.9, color="k", ls="--")
    axes[1, 0].set_ylabel("coverage of 90 % regions")
    axes[1, 1].axhline(0.0, color="k", ls="--")
    axes[1, 1].set_ylabel("log-score gap [nats]")
    for ax in axes[1]:
        names = [s.name for s in found.strata]
        ax.set_xticks(place, names, rotation=90, fontsize=7)
    return figure
