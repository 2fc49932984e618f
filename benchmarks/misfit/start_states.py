"""A trajectory verdict with a start state in each trial: what it costs.

    python -m benchmarks misfit.start_states --cases 1000 1010
    python -m benchmarks misfit.start_states --summary

A pendulum driven by a sine: two parameters, eight declared effects, twelve trials of 30
samples, and the angle and the speed at which a trial starts as nuisances of each. Each
case is run as it is, and beside a force that nobody declared. What is recorded: the
verdict, the smallest effective sample size behind the intervals of the bare model and
of the verdict's, that behind each effect alone, of which the report prints no interval
below 50, CPU seconds beside the simulator's own, and simulated trials. The bars are 50,
120 s and a median of 100,000.

Cases are seeds; those from 1,000 on judge. Resumable: a case that stands in
results/start_states.csv is not run again.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.distributions import HalfNormal, Independent, Normal

from benchmarks.criticism.intervals import rate
from benchmarks.rows import benchmark
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.report.words import FEW_DRAWS
from sbi_active.criticism.results import NONE
from sbi_active.display.table import Table

PATH = Path(__file__).parent / "results" / "start_states.csv"
NUM_TRIALS, NUM_SAMPLES, STEPS, DT = 12, 30, 4, 0.025
TIMES = DT * STEPS * torch.arange(1, NUM_SAMPLES + 1, dtype=torch.float64)
SENSOR = 0.01  # rad
WARM_UP = 0.55  # s
LEVEL = 0.9  # of intervals
BARS = {"ess": 50.0, "cpu_seconds": 120.0, "simulations": 100_000.0}

PRIOR = Independent(Normal(torch.tensor([9.0, 0.4]), torch.tensor([2.0, 0.15])), 1)
START = Effect.keyword(
    "start",
    "angle",
    "speed",
    prior=Independent(Normal(torch.zeros(2), torch.tensor([0.5, 1.0])), 1),
    scope="trial",
)
EFFECTS = (
    Effect.keyword("coulomb", prior=HalfNormal(0.5)),
    Effect.keyword("quadratic", prior=HalfNormal(0.3)),
    Effect.keyword("cubic", prior=Normal(0.0, 2.0)),
    Effect.keyword("torque", prior=Normal(0.0, 0.5)),
    Effect.keyword("gain", prior=Normal(0.0, 0.2)),
    Effect.keyword("lag", prior=HalfNormal(0.05)),
    Effect.keyword("bias", prior=Normal(0.0, 0.05)),
    Effect.keyword("drift", prior=Normal(0.0, 0.02)),
)


def swing(
    theta: Tensor,
    action: Tensor,
    *,
    angle: Tensor | float = 0.0,
    speed: Tensor | float = 0.0,
    coulomb: Tensor | float = 0.0,
    quadratic: Tensor | float = 0.0,
    cubic: Tensor | float = 0.0,
    torque: Tensor | float = 0.0,
    gain: Tensor | float = 0.0,
    lag: Tensor | float = 0.0,
    bias: Tensor | float = 0.0,
    drift: Tensor | float = 0.0,
    hidden: Tensor | float = 0.0,
) -> Tensor:
    """Return angles at the sample times, shape (n, 30), of a driven pendulum."""
    stiffness, damping = theta.double().T
    drive, rate = action.double().T
    q, v = 0 * stiffness + angle, 0 * stiffness + speed
    found = []
    for i in range(NUM_SAMPLES * STEPS):
        u = (1 + gain) * drive * torch.sin(rate * (DT * i)) + torque
        a = u - stiffness * torch.sin(q) - damping * v - cubic * q**3
        a = a - coulomb * torch.tanh(v / 0.1) - quadratic * v * v.abs()
        v = v + DT * (a + hidden * torch.cos(3 * q + 1.5 * v))
        q = q + DT * v
        if (i + 1) % STEPS == 0:
            found.append(q - lag * v + bias + drift * (DT * (i + 1)))
    return torch.stack(found, 1)


@dataclass(frozen=True)
class Case:
    """Measured trials and what made them.

    Attributes:
        trials: Twelve.
        theta: Shape (2,).
        name: Of the effect that is there.
        phi: Its strength.
        size: Of what nobody declared, root mean square in sensor deviations.
    """

    trials: Trials
    theta: Tensor
    name: str
    phi: float
    size: float


def draw_case(number: int, *, is_hidden: bool) -> Case:
    """Return a case; the same machine and effect with and without a hidden force."""
    rng = np.random.default_rng([number, 20])
    theta = torch.from_numpy(rng.normal([9.0, 0.4], [1.0, 0.1]))
    effect = EFFECTS[rng.integers(len(EFFECTS))]
    phi = float(effect.prior.stddev) * rng.uniform(1.0, 2.0)
    action = torch.from_numpy(rng.uniform([2.0, 1.0], [6.0, 4.0], (NUM_TRIALS, 2)))
    start = torch.from_numpy(rng.normal(0, [0.5, 1.0], (NUM_TRIALS, 2)))
    force = rng.uniform(0.15, 0.8)
    error = SENSOR * torch.from_numpy(rng.normal(size=(NUM_TRIALS, NUM_SAMPLES)))
    rows = theta.expand(NUM_TRIALS, -1)
    told = {"angle": start[:, 0], "speed": start[:, 1], effect.name: phi}
    x = clean = swing(rows, action, **told)
    if is_hidden:
        x = swing(rows, action, **told, hidden=force)
    size = float((x - clean).square().mean().sqrt()) / SENSOR
    trials = Trials(action, x + error, sample_times=TIMES)
    return Case(trials, theta, effect.name, phi, size)


def score_case(number: int, hidden: int) -> dict[str, object]:
    """Return the row of one case."""
    case, spent = draw_case(number, is_hidden=bool(hidden)), [0.0]

    def timed(theta: Tensor, action: Tensor, **keywords: Tensor) -> Tensor:
        begin = time.process_time()
        x = swing(theta, action, **keywords)
        spent[0] += time.process_time() - begin
        return x

    begin = time.process_time()
    loop = Criticism(
        SimulatorModel(timed, noise=GaussianNoise(SENSOR), batched=True),
        PRIOR,
        case.trials,
        effects=[START, *EFFECTS],
        warm_up=WARM_UP,
        seed=number,
    )
    tracing = loop.trace()
    seconds = time.process_time() - begin
    alone = np.array([e.effective_sample_size for e in tracing.estimates])
    own = {NONE, tracing.model} & {*tracing.evidences}
    inside, intervals = _coverage(loop, case)
    return {
        "size": case.size,
        "true": case.name,
        "verdict": tracing.verdict,
        "chosen": " + ".join(tracing.chosen),
        "is_misfit": int(tracing.misfit is not None),
        "ess": min(tracing.evidences[n].effective_sample_size for n in own),
        "cpu_seconds": seconds - spent[0],
        "simulations": loop.rivals.simulator.num_simulations,
        "simulator_seconds": spent[0],
        "ess_alone": float(alone.min()),
        "not_printed": int((alone < FEW_DRAWS).sum()),
        "inside": inside,
        "intervals": intervals,
    }


def _coverage(loop: Criticism, case: Case) -> tuple[int, int]:
    """Return how many 90 % intervals of the true model cover, and of how many."""
    evidence = loop.trace().evidences[case.name]
    low, high = np.quantile(evidence.draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    truth = np.array([*case.theta.tolist(), case.phi])
    return int(((low <= truth) & (truth <= high)).sum()), len(truth)


def summary(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the bars, with and without the hidden force."""
    header = ["hidden force", "smallest ESS", "ESS >= 50"]
    header += ["effects alone without a printed interval"]
    header += ["CPU s beside the simulator's, median (largest)"]
    header += ["simulated trials, median (largest)", "true effect in the verdict"]
    cells = []
    for hidden, label in (("0", "none"), ("1", "yes")):
        own = [row for row in rows if row["hidden"] == hidden]
        if not own:
            continue
        ess, seconds, trials = (
            np.array([float(row[name]) for row in own]) for name in BARS
        )
        if hidden == "1":
            sizes = [float(row["size"]) for row in own]
            label = f"{min(sizes):.1f} to {max(sizes):.1f} sensor deviations"
        named = [row["true"] in row["chosen"].split(" + ") for row in own]
        covered = [
            k < int(row["inside"]) for row in own for k in range(int(row["intervals"]))
        ]
        left = sum(int(row["not_printed"]) for row in own)
        cells.append(
            (
                *(label, f"{ess.min():.0f}", rate(ess >= BARS["ess"])),
                f"{left} of {len(EFFECTS) * len(own)}",
                f"{np.median(seconds):.0f} ({seconds.max():.0f})",
                f"{np.median(trials):,.0f} ({trials.max():,.0f})",
                *(rate(named), rate(covered)),
            )
        )
    return Table((*header, "90 % intervals that cover"), cells).markdown()


main = benchmark(PATH, score_case, summary, case=range(1000, 1010), hidden=(0, 1))
