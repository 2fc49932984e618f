"""The tables of the servo pendulum, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sbi_active.display.table import Table
from sbi_active.tasks.servo_pendulum import Recordings  # pyright: ignore

__all__ = ["tables"]

SHOWN = 0.005


def tables(rows: Mapping[str, dict[str, Any]], recordings: Recordings) -> str:
    """Return what each stage says.

    Args:
        rows: By stage, of ``judge``.
        recordings: For the names of trials.
    """
    parts = [_stages(rows, recordings)]
    parts += [
        _models(rows, name)
        for name in rows
        if name in ("powered", "motor off") or name.startswith("trials")
    ]
    if "motor off" in rows:
        row = rows["motor off"]
        parts += [_errors(row, recordings), _parameters(row), _rates(row["rates"])]
    if "powered, iid" in rows:
        parts.append(_independent(rows))
    return "\n\n".join(parts)


def _stages(rows: Mapping[str, dict[str, Any]], recordings: Recordings) -> str:
    header = ["stage", "trials", "verdict", "P(cause)", "90 % set", "log BF"]
    lines = []
    for name, row in rows.items():
        cause = ", ".join(f"{n} {p:.2f}" for n, p in row["cause"].items())
        odds = ", ".join(row["credible_set"]), f"{row['log_bayes_factor']:.1f}"
        ends = _next(row, recordings), f"{row['seconds']:.0f}"
        lines.append((name, len(row["fitted"]), row["verdict"], cause, *odds, *ends))
    return Table([*header, "next trial", "CPU s"], lines).markdown()


def _next(row: dict[str, Any], recordings: Recordings) -> str:
    if "gain" not in row:
        return ""
    if row["next"] is None:
        return "none"
    return f"{_named(row['next'], recordings)} ({max(row['gain']):.2f} nats)"


def _models(rows: Mapping[str, dict[str, Any]], stage: str) -> str:
    """Return the models of a stage, the likeliest first."""
    row = rows[stage]
    null = row["log_evidence"]["none"]
    lines = []
    for name, p in row["probabilities"].items():
        if p < SHOWN and " + " in name:
            continue
        phi = ""
        if name in row["singles"]:
            mean, sd = row["singles"][name][name]
            phi = f"{mean:.3g} +- {sd:.2g}"
        factor = f"{row['log_evidence'][name] - null:.1f}"
        lines.append((name, _probability(p), factor, phi))
    return Table((f"{stage}: model", "P", "log BF", "phi, alone"), lines).markdown()


def _errors(row: dict[str, Any], recordings: Recordings) -> str:
    """Return the held-out errors beside plain least squares."""
    each = [_named(i, recordings) for i in row["held_out"]]
    lines = []
    total = dict(
        zip(row["before_after"]["metric"], _pairs(row["before_after"]), strict=True)
    )["RMSE" if "RMSE" in row["before_after"]["metric"] else "rmse"]
    for i, (when, what) in enumerate(
        (("before", "bare model"), ("after", row["model"]))
    ):
        low, _, high = row["draws"][when]["rmse"]
        own = [f"{v:.3f}" for v in row["rmse"][when]]
        spread = f"{low:.3f} to {high:.3f}"
        lines.append((f"**{when}**: {what}", "", f"**{total[i]:.4f}**", spread, *own))
    for name, found in row["least squares"].items():
        own = [f"{v:.3f}" for v in found["each"]]
        sizes = f"{found['train']:.4f}", f"{found['held_out']:.4f}"
        lines.append((f"least squares: {name}", *sizes, "", *own))
    header = ("RMSE, rad", "fitted", "held out", "5 to 95 %", *each)
    return Table(header, lines).markdown()


def _pairs(table: dict[str, list[float]]) -> list[tuple[float, float]]:
    return [*zip(table["before"], table["after"], strict=True)]


def _parameters(row: dict[str, Any]) -> str:
    before, after = row["parameters"]["none"], row["parameters"].get(row["model"], {})
    lines = []
    for name in dict.fromkeys([*before, *after]):
        cells = [
            f"{found[name][0]:.4g} +- {found[name][1]:.2g}" if name in found else ""
            for found in (before, after)
        ]
        lines.append((name, *cells))
    return Table(("parameter", "bare model", row["model"]), lines).markdown()


def _independent(rows: Mapping[str, dict[str, Any]]) -> str:
    """Return what errors that are forced to be independent change."""
    lines = []
    for stage in ("powered", "motor off"):
        for errors, name in (("default", stage), ("independent", f"{stage}, iid")):
            if name not in rows:
                continue
            row = rows[name]
            z = row["log_evidence"]
            factors = " / ".join(f"{z[n] - z['none']:.0f}" for n in row["singles"])
            p = _probability(row["probabilities"].get(row["model"], 0.0))
            lines.append((stage, errors, row["verdict"], p, factors))
    factors = "log BF: Coulomb / load / torque / viscous"
    return Table(("stage", "errors", "verdict", "P", factors), lines).markdown()


def _rates(rows: Sequence[dict[str, Any]]) -> str:
    """Return how the evidence grows with the rate at which angles are compared."""
    rates = sorted({row["rate"] for row in rows}, reverse=True)
    found = {(row["model"], row["rate"]): row for row in rows}
    what = "log likelihood above none (correlation of innovations)"
    lines = []
    for model in dict.fromkeys(row["model"] for row in rows):
        cells = []
        for rate in rates:
            own, null = found[model, rate], found["none", rate]
            gain = own["log_likelihood"] - null["log_likelihood"]
            cells.append(f"{gain:.0f} ({own['innovations']:.2f})")
        lines.append((model, *cells))
    return Table((what, *(f"{rate:g} Hz" for rate in rates)), lines).markdown()


def _named(trial: int, recordings: Recordings) -> str:
    return f"{recordings.trajectory[trial]} {recordings.kp[trial]:.0f}"


def _probability(value: float) -> str:
    if value < SHOWN:
        return "< .01"
    return "> .99" if value > 1 - SHOWN else f"{value:.2f}"
