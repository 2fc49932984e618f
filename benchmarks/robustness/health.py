r"""False alarms: campaigns whose simulator is right, by how many numbers a trial has.

    python -m benchmarks robustness.health
    python -m benchmarks robustness.health --summary
    python -m benchmarks robustness.health --campaigns 0 20 --numbers 50 --lost sensor

Each campaign draws its parameters from the prior and three trials from the simulator
itself, so that any alarm is false; at most 5 % may raise one. Simulators take turns:
linear, nonlinear, noise that is correlated along the numbers. A fifth of the numbers is
lost to the sensor, of which the simulator knows nothing (of trials of one number, a
fifth, told as missing), or nothing is. Tests that do not count, as too few simulations
leave the belief off, are listed as such. Resumable:
``results/health.csv`` is appended to.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from attrs import evolve
from torch import Tensor
from torch.distributions import MultivariateNormal

from benchmarks.rows import benchmark
from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    MixtureDensity,
    RefinementOptions,
)
from sbi_active.campaign.health import is_off
from sbi_active.campaign.options import CampaignDetails
from sbi_active.diagnostics.calibration import clopper_pearson
from sbi_active.inference.networks.mixture_density import MixtureDetails
from sbi_active.seeding import derive_seed, forked_generators

RESULTS = Path(__file__).parent / "results" / "health.csv"
NUMBERS = (1, 10, 50, 200, 500, 1_000)
LOST = ("nothing", "sensor")
MANY = 200  # numbers
SHARE = 0.2  # of the numbers
NOISE = 0.1
NUM_TRIALS = 3
PRIOR = MultivariateNormal(torch.zeros(2), torch.eye(2))
ACTIONS = BoxActions([0.5], [2.0])
NETWORK = MixtureDensity(
    hidden_features=(8,),
    num_components=1,
    num_iterations=5,
    details=MixtureDetails(baseline="none"),
)
CHEAP = CampaignOptions(
    num_simulations=100,
    density_estimator=NETWORK,
    refinement=RefinementOptions(num_histories=1_000),
)
#: For campaigns of many numbers, which cost more.
CHEAPER = evolve(
    CHEAP,
    details=CampaignDetails(num_scored=1_000),
    refinement=RefinementOptions(num_histories=400),
)


def _grid(q: int) -> Tensor:
    return torch.linspace(0.0, 1.0, q) if q > 1 else torch.ones(1)


def _noise(theta: Tensor, q: int, correlation: float) -> Tensor:
    """Return stationary autoregressive noise, shape (n, q)."""
    e = torch.randn(len(theta), q)
    for j in range(1, q if correlation else 0):
        kept = (1 - correlation**2) ** 0.5 * e[:, j]
        e[:, j] = correlation * e[:, j - 1] + kept
    return NOISE * e


def linear(theta: Tensor, action: Tensor, q: int) -> Tensor:
    """A straight line with independent noise."""
    mean = theta[:, :1] * action + theta[:, 1:] * _grid(q)
    return mean + _noise(theta, q, 0.0)


def nonlinear(theta: Tensor, action: Tensor, q: int) -> Tensor:
    """A saturating oscillation, whose noise grows with it."""
    mean = torch.sin(action * _grid(q) + theta[:, :1]) * torch.tanh(1 + theta[:, 1:])
    return mean + (1 + mean.abs()) * _noise(theta, q, 0.0)


def correlated(theta: Tensor, action: Tensor, q: int) -> Tensor:
    """A straight line with noise that is correlated along the numbers."""
    mean = theta[:, :1] * action + theta[:, 1:] * _grid(q)
    return mean + _noise(theta, q, 0.9)


SIMULATORS = (linear, nonlinear, correlated)


def run_campaign(q: int, lost: str, index: int) -> dict[str, Any]:
    """Run one campaign and return its row."""
    truth, start = SIMULATORS[index % len(SIMULATORS)], time.process_time()
    seed = derive_seed(index, f"health {q} {lost}")

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return truth(theta, action, q)

    options = CHEAPER if q >= MANY else CHEAP
    run = Campaign(simulator, PRIOR, ACTIONS, method="nsbi", seed=seed, options=options)
    with forked_generators(seed, "theta"):
        theta = PRIOR.sample((1,))
    for k in range(NUM_TRIALS):
        action = run.ask().action
        with forked_generators(seed, "x", k):
            x = simulator(theta, action[None])[0]
            if lost == "sensor":
                x[torch.rand(q) < SHARE] = torch.nan
        if lost == "sensor" and bool(x.isnan().all()):
            run.tell(status="missing")
        else:
            run.tell(x)
        run.update()
    row, untested = {}, 0
    for trial in run.history:
        for name in ("surprise", "misfit"):
            p = getattr(trial, name)
            row[f"{name}_{trial.index + 1}"] = "" if p is None else f"{p:.3g}"
        if trial.status == "ok":
            off = is_off(trial.belief_error or 0.0)
            untested += off + (trial.misfit is None)
    seconds = time.process_time() - start
    row |= {"health": run.health, "untested": untested, "seconds": f"{seconds:.1f}"}
    return row


def _share(rows: list[dict[str, str]], name: str) -> float:
    values = [row[f"{name}_{k}"] for row in rows for k in (1, 2, 3)]
    known = [float(v) for v in values if v]
    return sum(v < 0.05 for v in known) / max(len(known), 1)


def _untested(rows: list[dict[str, str]]) -> float:
    tests = sum(2 * bool(row[f"surprise_{k}"]) for row in rows for k in (1, 2, 3))
    return sum(int(row["untested"]) for row in rows) / max(tests, 1)


def summary(rows: list[dict[str, str]]) -> Iterator[str]:
    """Yield the share of alarms by cell, and of surprises and misfits below .05."""
    yield (
        f"{'numbers':>7}  {'lost to':<10}{'n':>4}  {'alarms':<22}{'surprise < .05':>15}"
        f"{'misfit < .05':>14}{'untested':>10}{'seconds':>9}"
    )
    for q in NUMBERS:
        for lost in LOST:
            cell = [r for r in rows if r["numbers"] == str(q) and r["lost"] == lost]
            if not cell:
                continue
            n, count = len(cell), sum(row["health"] == "alarm" for row in cell)
            low, high = clopper_pearson(count, n, 0.05)
            seconds = sum(float(row["seconds"]) for row in cell) / n
            yield (
                f"{q:>7}  {lost:<10}{n:>4}  "
                f"{f'{count / n:.3f} [{low:.3f}, {high:.3f}]':<22}"
                f"{_share(cell, 'surprise'):>15.3f}{_share(cell, 'misfit'):>14.3f}"
                f"{_untested(cell):>10.3f}{seconds:>9.1f}"
            )


main = benchmark(
    RESULTS,
    run_campaign,
    lambda rows: "\n".join(summary(rows)),
    numbers=NUMBERS,
    lost=LOST,
    campaign=range(200),
)
