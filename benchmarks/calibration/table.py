"""The share of networks or beliefs that are flagged, by problem and kind."""

from __future__ import annotations

from benchmarks.rows import column, grouped
from sbi_active.diagnostics.calibration import clopper_pearson


def shares(rows: list[dict[str, str]]) -> str:
    """Return a line for each problem and kind."""
    lines = []
    for (problem, kind), own in grouped(rows, "problem", "kind").items():
        n, k = len(own), sum(row["verdict"] != "trust" for row in own)
        low, high = clopper_pearson(k, n, 0.05)
        line = f"{problem:12s} {kind:14s} flagged {k}/{n} ({low:.2f} to {high:.2f})"
        if kind == "one action":
            hit = [(r["wrong_flagged"] == "1", r["others_flagged"] == "0") for r in own]
            line += f", at the wrong action {sum(at for at, _ in hit)}"
            line += f", only there {sum(at and alone for at, alone in hit)}"
        lines.append(f"{line}; {column(own, 'cpu_seconds').mean():.1f} CPU s")
    return "\n".join(lines)
