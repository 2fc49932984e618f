"""What the closed loop said of images, from the rows of a run."""

from __future__ import annotations

import numpy as np

from benchmarks.rounds import Rows
from sbi_active.display.table import Table


def summarize(rows: Rows) -> str:
    """Return one line a set and the counts."""
    if not rows:
        return "no sets yet"
    table = [
        [
            f"{r['kind']} {r['case']}",
            r["truth"] + (f" {float(r['phi']):.3g}" if r["kind"] == "hidden" else ""),
            r["verdict"],
            f"{float(r['log_bayes']):.1f}",
            f"{float(r['p_truth']):.2f}" if r["kind"] == "hidden" else "",
            f"{float(r['rmse_before']):.2f} -> {float(r['rmse_after']):.2f}",
            f"{float(r['cpu_seconds']):.0f}",
        ]
        for r in rows
    ]
    header = ["set", "truth", "verdict", "log Bayes factor", "P(truth)"]
    header += ["held-out error, sd", "CPU s"]
    lines = [Table(header, table).text(), ""]
    hidden, clean, material = (
        [r for r in rows if r["kind"] == kind]
        for kind in ("hidden", "clean", "material")
    )
    if clean:
        alarms = sum(r["alarm"] == "True" for r in clean)
        lines.append(f"clean sets: {alarms} false alarms of {len(clean)}")
    if hidden:
        found = [r for r in hidden if r["alarm"] == "True"]
        top = sum(r["place"] == "1" for r in found)
        ratio = [float(r["rmse_after"]) / float(r["rmse_before"]) for r in found]
        middle = f"{np.median(ratio):.2f}" if ratio else "-"
        lines.append(
            f"hidden sets: {len(found)} of {len(hidden)} alarms; the effect, or one no "
            f"action separates from it, first in {top} of these; error after / before, "
            f"median {middle}"
        )
    if material:
        said = sum("unexplained" in r["verdict"] for r in material)
        alarms = sum(r["alarm"] == "True" for r in material)
        missed = sum(r["verdict"] == "none" for r in material)
        stand_ins = [r for r in material if r["verdict"] not in ("unexplained", "none")]
        ratio = [float(r["rmse_after"]) / float(r["rmse_before"]) for r in stand_ins]
        left = f", which leave {ratio_range(ratio)} of the error" if ratio else ""
        lines.append(
            f"material: {alarms} of {len(material)} alarms; 'unexplained' in {said}, "
            f"stand-ins in {len(stand_ins)}{left}; 'none' in {missed}"
        )
    return "\n".join(lines)


def ratio_range(ratio: list[float]) -> str:
    """Return the median and the range of some shares."""
    return f"{np.median(ratio):.2f} ({min(ratio):.2f} to {max(ratio):.2f})"
