"""Trials for a controller: asked about what it needs, or about everything.

    python -m benchmarks target
    python -m benchmarks target --summary

Two machines of eight parameters, of which a controller rests on three: ``cart_pole.py``
and ``leg.py``. Both arms know the same model and differ in the question alone: "theta"
designs for all parameters, "gains" for ``target=`` the controller's gains, both by
``LinearGain``. After each trial the posterior is normal around its mode, the controller
is that of the mode, and its cost on the true machine is compared with that of the right
controller. Costs are the same within 1 % of the latter. Rows are added to a file a
machine beside this one, and those that are there are not run again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from benchmarks.rows import benchmark, grouped
from benchmarks.target import cart_pole, leg
from sbi_active import (
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed

RESULT = Path(__file__).with_name("{machine}.csv")
MACHINES: dict[str, Any] = {"cart-pole": cart_pole, "leg": leg}
MOST, SAME, NUM_SAMPLES = 5, 0.01, 96


def posterior(
    machine: Any, actions: Tensor, x: Tensor, start: Tensor, *, num_steps: int = 5
) -> MultivariateNormal:
    """Return the normal around the mode of trials (t, 2), outcomes (t, numbers)."""
    scale = machine.SPREAD.double()
    mode = start.double() / scale
    num, step = len(actions), machine.DIFFERENCE

    def residual(u: Tensor) -> Tensor:
        """Whitened misfit and prior at several places (k, 8), (k, numbers)."""
        k = len(u)
        theta = (u * scale).repeat_interleave(num, 0)
        off = machine.trial(theta, actions.repeat(k, 1)) - x.repeat(k, 1)
        off = off / machine.SENSOR
        return torch.cat([off.reshape(k, -1), u], 1)

    damping = 1e-3
    for _ in range(num_steps):
        places = mode + torch.cat(
            [0 * mode[None], step * torch.eye(8), -step * torch.eye(8)]
        )
        rows = residual(places)
        slope = (rows[1:9] - rows[9:]).T / (2 * step)
        information = slope.T @ slope
        tries = [damping * 10.0**k for k in range(-1, 3)]
        moves = torch.stack(
            [
                -torch.linalg.solve(
                    information + d * information.diagonal().diag(), slope.T @ rows[0]
                )
                for d in tries
            ]
        )
        losses = residual(mode + moves).square().sum(1).nan_to_num(nan=torch.inf)
        best = int(losses.argmin())
        if not float(losses[best]) < float(rows[0].square().sum()):
            damping = min(damping * 100, 1e6)
            continue
        mode, damping = mode + moves[best], tries[best]
    covariance = torch.linalg.inv(information) * scale[:, None] * scale
    covariance = 0.5 * (covariance + covariance.T)
    return MultivariateNormal((mode * scale).float(), covariance.float())


def run(name: str, arm: str, truth: int) -> list[dict[str, Any]]:
    """Return a row a trial of one arm on one machine."""
    machine = MACHINES[name]
    generator = torch.Generator().manual_seed(derive_seed(truth, "truth"))
    theta = machine.SPREAD * torch.randn(1, 8, generator=generator)
    best = machine.cost(theta, machine.gains(theta))
    model = SimulatorModel(
        machine.trial,
        noise=GaussianNoise(machine.SENSOR),
        parameter_names=machine.NAMES,
    )
    designer = InformationGainDesigner(
        machine.TRIALS, num_samples=NUM_SAMPLES, estimator="linear"
    )
    belief = MultivariateNormal(torch.zeros(8), machine.SPREAD.diag().square())
    actions, outcomes = [], []
    target: Any = machine.gains if arm == "gains" else arm
    rows = []
    for k in range(MOST):
        design = designer.select(
            None, model, belief=belief, target=target, seed=derive_seed(truth, arm, k)
        )
        actions.append(design.action)
        x = machine.trial(theta, design.action[None])
        noise = torch.randn(x.shape, generator=generator)
        outcomes.append(x + machine.SENSOR * noise)
        known = torch.stack(actions), torch.cat(outcomes).double()
        belief = posterior(machine, *known, belief.mean)
        found = machine.cost(theta, machine.gains(belief.mean[None])) / best - 1
        row = {"arm": arm, "truth": truth, "trial": k + 1, "excess": float(found)}
        rows.append(row | {"kind": int(design.action[0]), "size": design.action[1]})
    return rows


def excess(rows: list[dict[str, str]]) -> list[Tensor]:
    """Return the cost beyond the right regulator's in shares of it, of each arm.

    Shape (truths, trials), of the true machines that both arms have.
    """
    known = {
        (row["arm"], int(row["truth"]), int(row["trial"])): float(row["excess"])
        for row in rows
    }
    truths = sorted({t for _, t, _ in known if ("gains", t, 1) in known})
    return [
        torch.tensor([[known[arm, t, k + 1] for k in range(MOST)] for t in truths])
        for arm in ("theta", "gains")
    ]


def table(rows: list[dict[str, str]]) -> str:
    """Return in how many truths a few trials are as good as more for everything."""
    lines = []
    for (name,), some in grouped(rows, "machine").items():
        lines += [[name, *line] for line in of_machine(some)]
    return Table(["", "trials", "for the gains", "for everything"], lines).text()


def of_machine(rows: list[dict[str, str]]) -> list[list[str]]:
    """Return the lines of one machine."""
    theta, own = excess(rows)
    lines = []
    for few, many in ((1, 2), (2, 4), (2, 5)):
        counts = []
        for arm in (own, theta):
            same = arm[:, few - 1] <= theta[:, many - 1] + SAME
            counts.append(f"{int(same.sum())} of {len(arm)}")
        lines.append([f"{few} as good as {many} for everything", *counts])
    # a machine that is not there after the last trial counts as one trial more
    num = [
        MOST + 1 - (arm <= SAME).int().flip(1).cumprod(1).sum(1) for arm in (own, theta)
    ]
    means = [f"{float(each.double().mean()):.2f}" for each in num]
    lines.append(["until the right controller's cost, for good", *means])
    half = f"{int((2 * num[0] <= num[1]).sum())} of {len(own)}"
    lines.append(["that cost with at most half as many", half, ""])
    middle = [f"{float(arm[:, 1].median()):.2%}" for arm in (own, theta)]
    lines.append(["median cost beyond it after two", *middle])
    return lines


main = benchmark(
    RESULT, run, table, machine=MACHINES, arm=("theta", "gains"), truth=range(50)
)
