"""The table of location finding: policies, paired differences, published figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.location_finding.bounds import near_cap
from benchmarks.published import published
from benchmarks.rows import read
from sbi_active.display.table import Table

RESULTS = Path(__file__).parent / "results"
FULL = 500_000  # contrastive draws that a file's name leaves out

Rows = dict[int, dict[str, float]]  # by roll-out

NAMES = {
    "random": "random",
    "fixed": "fixed, optimized",
    "myopic": "myopic, refined belief (ASBI)",
    "myopic_particles": "myopic, particles (exact likelihood)",
}
#: sPCE and sNMC, 30 trials, 2,048 roll-outs, as reported by Foster et al. (2021).
PUBLISHED = published("location finding")
BOUNDS = ("spce", "snmc", "lower", "upper")
COSTS = ("cpu_design", "cpu_belief", "cpu_bounds")


def path_of(folder: Path, policy: str, num_trials: int, num_contrastive: int) -> Path:
    """Return the file of a policy."""
    name = f"{policy}_{num_trials}"
    name += "" if num_contrastive == FULL else f"_L{num_contrastive}"
    return folder / f"{name}.csv"


def by_rollout(path: Path) -> Rows:
    """Return the roll-outs of a policy, none where there is no file."""
    keys = (*BOUNDS, *COSTS, "effective", "belief_gain")
    return {
        int(row["rollout"]): {key: float(row.get(key) or "nan") for key in keys}
        for row in read(path)
    }


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean over roll-outs and its standard error; nan for one roll-out."""
    if len(values) < 2:
        return float(values.mean()), float("nan")
    return float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)


def difference(
    better: Rows, worse: Rows, low: str = "lower", high: str = "upper"
) -> tuple[float, float, int]:
    """Return a lower bound of one policy's lead over another, over paired roll-outs.

    That is the lower bound of the first less the upper bound of the second.

    Returns:
        Mean, standard error and the number of roll-outs that both have.
    """
    common = sorted(set(better) & set(worse))
    values = np.array([better[i][low] - worse[i][high] for i in common])
    return *mean_and_error(values), len(common)


def table(folder: Path, num_trials: int, num_contrastive: int) -> str:
    """Return the table, and lines on the paired differences."""
    paths = {p: path_of(folder, p, num_trials, num_contrastive) for p in NAMES}
    policies = {p: by_rollout(path) for p, path in paths.items()}
    policies = {p: rows for p, rows in policies.items() if rows}
    cells, lines = [], []
    for policy, rows in policies.items():
        columns = {k: np.array([r[k] for r in rows.values()]) for k in rows[min(rows)]}
        means = {k: mean_and_error(columns[k]) for k in BOUNDS}
        cpu = [f"{columns[k].mean():.1f}" for k in COSTS]
        bounds = [f"{mean:.2f} +- {error:.2f}" for mean, error in means.values()]
        cells.append([f"{NAMES[policy]} ({len(rows)})", *bounds, " / ".join(cpu)])
        if near_cap(means["spce"][0], num_contrastive):
            lines.append(f"{policy}: sPCE is at its cap; sNMC rests on few draws")
        gap = columns["belief_gain"] - columns["lower"]
        if np.isfinite(gap).all():
            close = np.mean(np.abs(gap) < 0.5)
            lines.append(
                f"{policy}: log belief at the truth less the exact value, median "
                f"{np.median(gap):+.2f}, within .5 nat in {close:.2f} of the roll-outs"
            )
    for policy in [p for p in policies if p.startswith("myopic")]:
        for other in [p for p in ("random", "fixed") if p in policies]:
            for low, high in (("spce", "snmc"), ("lower", "upper")):
                mean, error, num = difference(
                    policies[policy], policies[other], low, high
                )
                lines.append(
                    f"{policy} {low} less {other} {high}: {mean:+.2f} +- {error:.2f} "
                    f"({num} paired roll-outs)"
                )
    if num_trials == 30:
        cells += [[name, *pair, "", "", ""] for name, pair in PUBLISHED.items()]
    header = [f"{num_trials} trials (roll-outs)", "sPCE", "sNMC", "lower", "upper"]
    header.append("CPU s: design / belief / bounds")
    return "\n".join([Table(header, cells).text(), *lines])
