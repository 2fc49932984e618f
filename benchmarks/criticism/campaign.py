r"""A campaign that starts on the wrong simulator, is alarmed, and goes on.

    python -m benchmarks criticism.campaign --kind hidden --cases 40
    python -m benchmarks criticism.campaign --kind clean --cases 40
    python -m benchmarks criticism.campaign --summary

The numerical task, :math:`x = \theta_1 e^{3 - \xi} + \theta_2 \xi + \varepsilon`, with
theta drawn from its prior. "hidden": the real system adds :math:`c \xi^2`, c drawn from
N(0, 1), from the first trial on. The campaign is given the bare simulator and the
library of world A, in which the quadratic is one of seven effects, and designs its
actions (``--policy auto``): for the parameters, or for which model is right where that
tells more. After an alarm it goes on asking while rivals are open, and adopts what the
verdict names once that is settled, or when its trials are spent. Nothing else of the
truth reaches it. Policy
"check" designs for the parameters alone, and makes every second trial where none was.

One row a case. Resumable: a case that stands in the CSV is not run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor
from torch.distributions import Distribution

from benchmarks.criticism.intervals import rate
from benchmarks.criticism.worlds import get_world
from benchmarks.criticism.worlds.numerical import NOISE_SD, response
from benchmarks.rows import resumed
from sbi_active import Campaign, CampaignOptions
from sbi_active.criticism import Report
from sbi_active.seeding import derive_seed, forked_generators, row_normals

RESULTS = Path(__file__).parent / "results"
KINDS = ("hidden", "clean")
POLICIES = ("auto", "check")
NUM_TRIALS = 6
NUM_DRAWS = 4_000
COLUMNS = [
    *["case", "kind", "strength", "theta", "actions", "lambda", "alarm_at", "health"],
    *["surprises", "misfits", "mass_before", "log_p_before", "verdict", "adopted"],
    *["mass_after", "log_p_after", "log_p_exact", "mass_exact", "health_after"],
    *["cpu_seconds", "failure"],
]


def draw_truth(kind: str, number: int) -> tuple[Tensor, float]:
    """Return theta, shape (1, 2), and the strength c, 0 for "clean"."""
    world = get_world("A")
    with forked_generators(number, "campaign", kind):
        theta = world.prior.sample(torch.Size([1]))
        strength = float(torch.randn(())) if kind == "hidden" else 0.0
    return theta, strength


def real_system(
    theta: Tensor, strength: float, number: int
) -> Callable[[Tensor, int], Tensor]:
    """Return ``measure(action, index)``, the one place that knows the truth."""

    def measure(action: Tensor, index: int) -> Tensor:
        seed = torch.tensor([derive_seed(number, "measurement", index)])
        noise = NOISE_SD * row_normals(seed, 1)[0].float()
        return response(theta, action[None], quadratic=strength)[0] + noise

    return measure


def run_case(
    kind: str,
    number: int,
    *,
    num_trials: int = NUM_TRIALS,
    policy: str = "auto",
) -> dict[str, object]:
    """Return the row of one campaign.

    It runs for ``num_trials`` trials, or until the first alarm. Then, and not without
    an alarm, the simulator is compared with the trials; while the verdict names no
    effect, or not one alone, further trials are made, up to ``num_trials`` in all.

    Args:
        kind: "hidden" or "clean".
        number: Of the case; also the campaign's seed.
        num_trials: Trials at most.
        policy: Of the actions, see above.
    """
    world = get_world("A")
    theta, strength = draw_truth(kind, number)
    measure = real_system(theta, strength, number)
    row: dict[str, object] = {
        "strength": strength,
        "theta": " ".join(f"{v:.6g}" for v in theta[0].tolist()),
    }
    start = time.process_time()
    campaign = Campaign(
        world.model,
        world.prior,
        world.actions,
        effects=world.effects if policy == "auto" else (),
        seed=number,
        options=CampaignOptions(check_every=2 if policy == "check" else None),
    )
    alarm_at: int | str = ""
    while len(campaign.history) < num_trials:
        trial = campaign.ask()
        campaign.tell(measure(trial.action, trial.index))
        campaign.update()
        if campaign.health == "alarm":
            alarm_at = alarm_at or len(campaign.history)
            if not row.get("log_p_before"):
                row |= _belief_cells(campaign.belief, theta, "before")
            report = campaign.criticize(world.effects, evaluate=False)
            row["verdict"] = report.verdict
            spent = len(campaign.history) == num_trials
            if report.tracing.chosen and (spent or settled(report)):
                row |= _at(campaign, theta, strength) | {"alarm_at": alarm_at}
                campaign.adopt(report)
                row |= {"adopted": " + ".join(report.tracing.chosen)}
                row |= _belief_cells(campaign.belief, theta, "after")
                row["health_after"] = campaign.health
                break
    else:
        row |= _at(campaign, theta, strength) | {"alarm_at": alarm_at}
        if "log_p_before" not in row:
            row |= _belief_cells(campaign.belief, theta, "before")
    return row | {"cpu_seconds": time.process_time() - start}


def settled(report: Report) -> bool:
    """Return whether the 90 % set is the verdict and what nothing separates from it."""
    groups = [group for group in report.equivalent if report.verdict in group]
    return {*report.credible_set} <= {report.verdict}.union(*groups)


def _at(campaign: Campaign, theta: Tensor, strength: float) -> dict[str, object]:
    """Return what the trials so far look like, and the exact posterior's cells."""
    trials = campaign.history
    action = torch.stack([t.action for t in trials]).double()
    x = torch.stack([t.x for t in trials if t.x is not None]).double()
    return {
        "actions": " ".join(f"{float(a):g}" for a in action),
        "lambda": non_centrality(action, theta, strength),
        "health": campaign.health,
        "surprises": " ".join(f"{t.surprise:.3g}" for t in trials),
        "misfits": " ".join(f"{t.misfit:.3g}" for t in trials),
    } | _exact_cells(action, x, theta, quadratic=strength != 0)


def non_centrality(action: Tensor, theta: Tensor, strength: float) -> float:
    """Return what the bare model, refitted within its prior, leaves of noise-free data.

    Args:
        action: Shape (t, 1).
        theta: Shape (1, 2).
        strength: Of the quadratic.

    Returns:
        The sum of squares in units of the noise.
    """
    xi = action[:, 0].double().numpy()
    design = np.stack([np.exp(3 - xi), xi], 1)
    target = design @ theta[0].double().numpy() + strength * xi**2
    scale = np.linalg.norm(design, axis=0)
    fit = lsq_linear(
        design / scale, target, bounds=(-5 * scale, 5 * scale), method="bvls"
    )
    return float(2 * fit.cost) / NOISE_SD**2


def _belief_cells(belief: Distribution, theta: Tensor, when: str) -> dict[str, object]:
    """Return log p(theta_true) and the mass of the region that excludes it.

    By a kernel estimate in coordinates whitened by the belief, which integrates the
    effects' phi out; log p of a belief over theta alone is its own.
    """
    with forked_generators(0, "region"):
        draws = belief.sample(torch.Size([NUM_DRAWS])).double()
    cells = _marginal_cells(draws[:, : theta.shape[1]], theta, when)
    if draws.shape[1] == theta.shape[1]:  # the belief's own density, with its floor
        cells[f"log_p_{when}"] = float(belief.log_prob(theta)[0])
    return cells


def _marginal_cells(draws: Tensor, theta: Tensor, when: str) -> dict[str, object]:
    """Return the same from draws of theta, by a Gaussian kernel estimate."""
    n, d = draws.shape
    covariance = torch.cov(draws.T)
    ridge = 1e-10 * covariance.diagonal().max() + 1e-12
    root = torch.linalg.cholesky(covariance + ridge * torch.eye(d))
    middle = draws.mean(0)
    z, own = (
        torch.linalg.solve_triangular(root, (t.double() - middle).T, upper=False).T
        for t in (draws, theta)
    )
    width = (4 / ((d + 2) * n)) ** (1 / (d + 4))
    unit = -np.log(n) - d * np.log(width * np.sqrt(2 * np.pi))
    unit -= float(root.diagonal().log().sum())
    at_draws = (-0.5 * torch.cdist(z, z).square() / width**2).logsumexp(1) + unit
    at_truth = (-0.5 * torch.cdist(own, z).square() / width**2).logsumexp(1) + unit
    inner = float((at_draws > at_truth).double().mean())
    return {f"log_p_{when}": float(at_truth), f"mass_{when}": inner}


def _exact_cells(
    action: Tensor, x: Tensor, theta: Tensor, *, quadratic: bool
) -> dict[str, object]:
    r"""Return both for the posterior of the right model, linear in (theta, c).

    .. math::
        p(\theta, c | x) \propto N(x; F (\theta, c), I)\, N(c; 0, 1)\,
        1[|\theta_i| \le 5], by rejection.
    """
    xi = action[:, 0]
    design = torch.stack([torch.exp(3 - xi), xi, xi**2], 1)[:, : 3 if quadratic else 2]
    precision = design.T @ design / NOISE_SD**2
    precision = precision + 1e-9 * torch.eye(len(precision))
    if quadratic:
        precision[2, 2] += 1.0
    covariance = torch.linalg.inv(precision)
    mean = covariance @ design.T @ x[:, 0] / NOISE_SD**2
    normal = torch.distributions.MultivariateNormal(mean, covariance)
    with forked_generators(0, "exact"):
        draws = normal.sample(torch.Size([200_000]))[:, :2]
    inside = draws[(draws.abs() <= 5).all(1)][:NUM_DRAWS]
    if len(inside) < 100:
        return {}
    return _marginal_cells(inside, theta, "exact")


def summary(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the lines of the table."""
    lines = [f"failed {r['case']}: {r['failure']}" for r in rows if r["failure"]]
    rows = [r for r in rows if not r["failure"]]
    clean = [r for r in rows if r["kind"] == "clean"]
    hidden = [r for r in rows if r["kind"] == "hidden"]
    strong = [r for r in hidden if float(r["lambda"]) > 25]
    if clean:
        lines += [
            "## clean campaigns",
            f"false alarms {rate([r['alarm_at'] != '' for r in clean])}",
            f"adopted {rate([r['adopted'] != '' for r in clean])}",
            f"theta_true in the 90 % region "
            f"{rate([float(r['mass_before']) <= 0.9 for r in clean])}",
        ]
    if not hidden:
        return lines
    adopted = [r for r in hidden if r["adopted"]]
    right = [r for r in adopted if r["adopted"] == "quadratic"]
    fooled = [r for r in strong if float(r["mass_before"]) > 0.99]
    lines += [
        "## campaigns with a hidden quadratic",
        f"alarm within {NUM_TRIALS} trials, all {_alarms(hidden)}",
        f"alarm within {NUM_TRIALS} trials, lambda > 25 {_alarms(strong)}",
        "theta_true outside the 99 % region at the alarm, lambda > 25 "
        + rate([r in fooled for r in strong]),
        "adopted, of the alarms "
        + rate([r in adopted for r in hidden if r["alarm_at"]]),
        f"of these the quadratic {rate([r in right for r in adopted])}",
        "theta_true in the 90 % region after adoption "
        + rate([float(r["mass_after"]) <= 0.9 for r in adopted]),
        "the same where the quadratic was adopted "
        + rate([float(r["mass_after"]) <= 0.9 for r in right]),
    ]
    for name in ("before", "after", "exact"):
        values = [float(r[f"log_p_{name}"]) for r in adopted if r[f"log_p_{name}"]]
        if values:
            lines.append(
                f"log p(theta_true), {name}: median {np.median(values):.2f}, "
                f"range {min(values):.2f} to {max(values):.2f}"
            )
    return lines


def _alarms(rows: Sequence[Mapping[str, str]]) -> str:
    return rate([r["alarm_at"] != "" for r in rows])


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        kind: Kind of cases; all by default.
        cases: Number of cases.
        first: Number of the first case.
        trials: Number of trials.
        policy: Names of the policies.
        out: File of the results.
        summary: Whether to run nothing, and print the table of the rows.
    """

    kind: Annotated[str | None, KINDS] = None
    cases: int = 40
    first: int = 0
    trials: int = NUM_TRIALS
    policy: Annotated[str, POLICIES] = POLICIES[0]
    out: Path = RESULTS
    summary: bool = False


def main(arguments: Settings) -> None:
    """Run what is asked for and print the table."""

    def made(number: int, kind: str) -> Mapping[str, Any]:
        options = {"num_trials": arguments.trials, "policy": arguments.policy}
        return dict.fromkeys(COLUMNS, "") | run_case(kind, number, **options)

    last = arguments.first + arguments.cases
    rows: list[dict[str, str]] = []
    for kind in KINDS:
        is_run = not arguments.summary and arguments.kind in (None, kind)
        jobs = [(n, kind) for n in range(arguments.first, last) if is_run]
        path = arguments.out / f"campaign_{kind}_{arguments.policy}.csv"
        rows += resumed(path, ["case", "kind"], jobs, made, may_fail=True)
    print("\n".join(summary(rows)))
