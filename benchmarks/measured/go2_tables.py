"""Tables of the Go2's legs in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["tables"]

PARTS = ("fitted", "held out")


def tables(rows: Mapping[str, Any]) -> str:
    """Return verdicts, errors and parameters.

    Args:
        rows: By stage.
    """
    judged = {name: row for name, row in rows.items() if "line" in row}
    lines = [
        "| stage | verdict | P(cause) | simulated trials | CPU s |",
        "|---|---|---|---|---|",
    ]
    for name, row in judged.items():
        for k, one in enumerate(row.get("rounds", [row])):
            causes = ", ".join(f"{n} {one['cause'][n]:.2f}" for n in one["helps"])
            verdict = one["verdict"]
            if one["helps"] and not one["named"]:
                verdict += f", {' + '.join(one['helps'])} helps"
            label, cost = name, f"{row['trial_simulations']:,}"
            seconds = f"{row['cpu_seconds']:.0f}"
            if "rounds" in row:
                label = f"{name}, round {k + 1}"
                cost, seconds = (cost, seconds) if k == 0 else ("", "")
            lines.append(f"| {label} | {verdict} | {causes} | {cost} | {seconds} |")
    lines += [
        "",
        "| RMSE, mrad: hip / thigh / knee | fitted | held out |",
        "|---|---|---|",
    ]
    for name, row in rows.items():
        if "line" not in row:
            for given, fit in row.items():
                lines.append(f"| {name}: {given} | {_errors(fit)} |")
            continue
        lines.append(f"| {name}: before | {_errors(row['before'])} |")
        for k, one in enumerate(row.get("rounds", [row])):
            label = f", round {k + 1}" if "rounds" in row else ""
            lines.append(f"| {name}: after{label} | {_errors(one['after'])} |")
    lines += ["", "| parameters and strengths | mean +- sd |", "|---|---|"]
    for name, row in judged.items():
        if "," not in name:
            for what, (mean, sd) in row["parameters"].items():
                lines.append(f"| {what} | {mean:.3g} +- {sd:.2g} |")
    return "\n".join(lines)


def _errors(row: Mapping[str, Any]) -> str:
    return " | ".join(" / ".join(f"{1e3 * e:.1f}" for e in row[part]) for part in PARTS)
