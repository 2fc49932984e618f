"""Pictures of a report: what is drawn, with a caption and in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import (
    plot_before_after,
    plot_probabilities,
    plot_residuals,
)
from sbi_active.criticism.report.headline import added
from sbi_active.display.page import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = {
    "residuals": "Residuals of the models refitted to all trials, in standard "
    "deviations of the prediction; the band is two of them. Each row has its scale, "
    "logarithmic beyond the band where residuals are large.",
    "probabilities": "Posterior probability of the models that were tried.",
    "before_after": "One line a scored trial; the bars are over all of them. "
    "Lower is better for the first two, higher for the third; the dotted line is 90 %.",
}


def figures(report: Contents) -> dict[str, Figure]:
    """Return the report's figures by name."""
    found = {
        "residuals": plot_residuals(
            report.residuals,
            report.residuals_after,
            action_labels=() if report.action_is_label else report.action_labels,
            channel_names=report.channel_names,
            added=added(report),
        ),
        "probabilities": plot_probabilities(report.tracing),
    }
    if report.evaluation is not None:
        found["before_after"] = plot_before_after(report.evaluation)
    return found


def pictured(report: Contents, name: str) -> Picture:
    """Return the place of the figure with a name."""
    words = f"{CAPTIONS[name]} {_told(report, name)}".strip()
    return Picture(name, words, CAPTIONS[name])


def _told(report: Contents, figure: str) -> str:
    """Return the numbers of a figure in words, for who does not see it."""
    if figure == "probabilities":
        shares = sorted(report.probabilities.items(), key=lambda item: -item[1])[:5]
        return ", ".join(f"{name}: {share:.2f}" for name, share in shares) + "."
    if figure == "before_after":
        names = report.before_after["metric"]
        values = report.before_after[["before", "after"]].to_numpy(dtype=float)
        pairs = zip(names, values, strict=True)
        return "; ".join(f"{n}: {a:.3g} to {b:.3g}" for n, (a, b) in pairs) + "."
    each = report.residuals.refitted
    finite = each[np.isfinite(each)]
    largest = np.abs(finite).max(initial=0.0)
    return f"The largest of the bare model is {largest:.3g} standard deviations."
