"""Forces that nobody declared, hidden in a pendulum whose truth is known.

    python -m benchmarks.forces.run --kind single --first 1000 --cases 10
    python -m benchmarks.forces.run --kind clean --first 1000 --cases 5
    python -m benchmarks.forces.run --summary

A driven pendulum of two unknown parameters, ten trials of 20 samples. single: one force
of the dictionary, of a size at which the refitted bare model misses by a chi-square of
40 to 2,000 over its degrees of freedom; forms that parameters or the drive absorb are
drawn again. outside: a force that is in no dictionary (a magnet, friction in two zones,
a spring that saturates). clean: none. Seeds are the numbers of cases; those below 1,000
are for tuning, and nothing may be tuned on those from 1,000 on.

Resumable: a case that stands in the CSV is not run again. Give each command a core of
its own (OMP_NUM_THREADS=1).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import BoxUniform
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.criticism.intervals import rate
from benchmarks.criticism.run import append, read
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.forces import force_effects, total_force
from sbi_active.criticism.forces.dictionary import FORMS

Array = NDArray[Any]

RESULT = Path(__file__).parent / "result.csv"
COLUMNS = [
    *["case", "kind", "form", "size", "excess", "verdict", "family", "p_family"],
    *["p_form", "set", "held_bare", "held_after", "simulated_trials", "cpu_seconds"],
]
KINDS = ("single", "outside", "clean")
FIRST_JUDGED = 1_000
SD, STEP, STEPS, EVERY = 0.003, 0.02, 100, 5
TIMES = STEP * EVERY * torch.arange(1, STEPS // EVERY + 1, dtype=torch.float64)
LOW, HIGH = (5.0, 0.0, 0.5), (15.0, 1.0, 2.0)
PRIOR = BoxUniform(torch.tensor(LOW), torch.tensor(HIGH))
NUM_TRIALS, NUM_HELD_OUT = 10, 6
EXCESS = 40.0, 2_000.0
#: Level of the set of effects that is to hold the truth.
LEVEL = 0.95

OUTSIDE: dict[str, Callable[[Array, Array], Array]] = {
    "magnet": lambda q, v: -(q / 0.3) / (1 + (q / 0.3) ** 2) ** 2,
    "friction in two zones": lambda q, v: -v / (1 + np.exp(-(q - 0.2) / 0.05)),
    "spring that saturates": lambda q, v: np.tanh(3 * q),
}


@dataclass(frozen=True)
class Hidden:
    """The force of the truth."""

    form: str
    size: float

    def __call__(self, q: Array, v: Array, t: float, phi: Array) -> Array:
        """Return the force, shape (n, 1); the trial's place is in phi."""
        if self.form in OUTSIDE:
            return self.size * OUTSIDE[self.form](q, v)
        horizon = STEP * STEPS
        return self.size * FORMS[self.form][1](q, v, t / horizon, phi[:, -1:])


def swing(theta: Tensor, action: Tensor, *, force: Any = None) -> Tensor:
    """Return angles of a driven pendulum, shape (n, 20), rad.

    Args:
        theta: Gravity and damping over inertia, and the drive's gain, shape (n, 3).
        action: Start, rad, size and frequency of the drive, shape (n, 3).
        force: Generalized forces.
    """
    g, c, gain = theta.double().T[..., None]
    q, size, rate_ = (column[:, None] for column in action.double().T)
    v, found = torch.zeros_like(q), []
    for k in range(STEPS):
        t = k * STEP
        tau = gain * size * torch.sin(rate_ * t) - g * torch.sin(q) - c * v
        v = v + STEP * (tau + total_force(force, q, v, t))
        q = q + STEP * v
        if (k + 1) % EVERY == 0:
            found.append(q[:, 0])
    return torch.stack(found, 1).to(theta.dtype)


def run_case(kind: str, number: int) -> dict[str, object]:
    """Hide a force, close the loop, and return the row of the results."""
    generator = torch.Generator().manual_seed(number)
    num = NUM_TRIALS + NUM_HELD_OUT

    def uniform(low: float, high: float) -> Tensor:
        u = torch.rand(num, generator=generator, dtype=torch.float64)
        return low + (high - low) * u

    action = torch.stack([uniform(-1.2, 1.2), uniform(0, 3), uniform(1, 6)], 1)
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    share = 0.2 + 0.6 * torch.rand(3, generator=generator)
    theta = (low + (high - low) * share).double()[None]
    hidden, excess = _hidden(kind, theta, action, generator)
    clean = _responses(theta, action, hidden)
    noise = torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    fitted = slice(0, NUM_TRIALS)
    trials = Trials(action[fitted], (clean + SD * noise)[fitted], sample_times=TIMES)
    model = SimulatorModel(
        swing, noise=GaussianNoise(SD), batched=True, sample_times=TIMES
    )
    begin = time.process_time()
    effects = force_effects(model, PRIOR, trials, joints=["hinge"], seed=number)
    loop = Criticism(model, PRIOR, trials, effects=effects, seed=number)
    tracing = loop.trace()
    seconds = time.process_time() - begin
    families = {e.name: str(e.family) for e in effects}
    p: dict[str, float] = {}
    for key, value in tracing.probabilities.items():
        for family in {families[n] for n in key.split(" + ") if n in families}:
            p[family] = p.get(family, 0.0) + value
    top = max(p, key=p.__getitem__) if tracing.chosen else ""
    form = "" if hidden is None else f"{hidden.form} of hinge"
    held = slice(NUM_TRIALS, num)
    before, after = (
        _held_out(loop, names, action[held], clean[held])
        for names in ((), tracing.chosen)
    )
    return {
        "case": number,
        "kind": kind,
        "form": form,
        "size": 0.0 if hidden is None else hidden.size,
        "excess": excess,
        "verdict": tracing.verdict,
        "family": top,
        "p_family": p.get(top, 0.0),
        "p_form": tracing.inclusion.get(form, 0.0),
        "set": " | ".join(_set(tracing.probabilities)),
        "held_bare": before,
        "held_after": after,
        "simulated_trials": loop.rivals.simulator.num_simulations,
        "cpu_seconds": seconds,
    }


def _hidden(
    kind: str, theta: Tensor, action: Tensor, generator: torch.Generator
) -> tuple[Hidden | None, float]:
    """Return a force of a size that shows, and the chi-square that it leaves."""
    if kind == "clean":
        return None, 0.0
    names = [*(FORMS if kind == "single" else OUTSIDE)]
    while True:
        form = names[int(torch.randint(len(names), (1,), generator=generator))]
        u = float(torch.rand((), generator=generator))
        wanted = float(np.exp(np.log(EXCESS[0]) + u * np.log(EXCESS[1] / EXCESS[0])))
        sign = -1.0 if torch.rand((), generator=generator) < 0.5 else 1.0
        size = 0.1
        for _ in range(6):  # the excess goes with the square of the size
            found = _excess(theta, action, Hidden(form, sign * size))
            if not np.isfinite(found) or size > 10:
                break
            if 0.8 < found / wanted < 1.25:
                return Hidden(form, sign * size), found
            size *= float(np.clip(np.sqrt(wanted / max(found, 1e-9)), 0.2, 5.0))


def _excess(theta: Tensor, action: Tensor, hidden: Hidden) -> float:
    """Return the chi-square of the refitted bare model on clean fitted trials."""
    target = _responses(theta, action, hidden)[:NUM_TRIALS]
    if not bool(target.isfinite().all()):
        return np.inf

    def residual(z: Array) -> Array:
        x = _responses(torch.from_numpy(z)[None], action[:NUM_TRIALS], None)
        return ((x - target) / SD).numpy().ravel()

    start = theta[0].numpy()
    return 2 * float(least_squares(residual, start, bounds=(LOW, HIGH)).cost)


def _responses(theta: Tensor, action: Tensor, hidden: Hidden | None) -> Tensor:
    place = torch.linspace(-1, 1, NUM_TRIALS, dtype=torch.float64)
    place = torch.cat([place, torch.zeros(len(action) - len(place)).double()])
    force = None if hidden is None else {hidden: place[:, None]}
    return swing(theta.expand(len(action), -1), action, force=force)


def _set(probabilities: dict[str, float]) -> list[str]:
    found, total = [], 0.0
    for name, p in probabilities.items():
        found.append(name)
        total += p
        if total >= LEVEL:
            break
    return found


def _held_out(
    loop: Criticism, names: tuple[str, ...], action: Tensor, clean: Tensor
) -> float:
    """Return the rms error of the mean prediction, in sensor deviations."""
    model, prior = loop.add(names)
    key = " + ".join(names) or "none"
    draws = torch.from_numpy(loop.trace().evidences[key].draws)[:50]
    width = prior.event_shape[0]
    rows = draws[:, :width].repeat_interleave(len(action), 0)
    x = model.mean(rows, action.repeat(len(draws), 1)).double()
    mean = x.reshape(len(draws), len(action), -1).mean(0)
    return float(((mean - clean) ** 2).mean().sqrt() / SD)


def summary(rows: list[dict[str, str]]) -> list[str]:
    """Return the lines of the table."""
    lines = ["| measure | share |", "|---|---|"]
    single = [r for r in rows if r["kind"] == "single"]
    named = {
        f"{n} of hinge": f"force in {what} of hinge" for n, (what, _) in FORMS.items()
    }
    hits = {
        "single: right family": [named[r["form"]] == r["family"] for r in single],
        "single: right form on top": [r["verdict"] == r["form"] for r in single],
        "single: truth in the 95 % set": [
            r["form"] in r["set"].split(" | ") for r in single
        ],
        "outside: held-out error falls": [
            float(r["held_after"]) < float(r["held_bare"])
            for r in rows
            if r["kind"] == "outside"
        ],
        "clean: something named": [
            r["verdict"] != "none" for r in rows if r["kind"] == "clean"
        ],
    }
    lines += [f"| {name} | {rate(hit)} |" for name, hit in hits.items()]
    trials = [float(r["simulated_trials"]) for r in rows]
    seconds = [float(r["cpu_seconds"]) for r in rows]
    if rows:
        lines.append(
            f"\n{np.median(trials):,.0f} simulated trials and {np.median(seconds):.0f} "
            f"CPU s a verdict in the median, {max(trials):,.0f} and {max(seconds):.0f} "
            "at most"
        )
    return lines


def main() -> None:
    """Run what is asked for and print the table of the judging seeds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--first", type=int, default=FIRST_JUDGED)
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--summary", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    kinds = (arguments.kind,) if arguments.kind else KINDS
    for kind in kinds if not arguments.summary else ():
        done = {(r["kind"], int(r["case"])) for r in read(RESULT)}
        for number in range(arguments.first, arguments.first + arguments.cases):
            if (kind, number) in done:
                continue
            row = run_case(kind, number)
            append(RESULT, [row], COLUMNS)
            print(
                f"{kind} {number}: {row['form'] or 'nothing'} -> {row['verdict']}, "
                f"{row['family']} {row['p_family']:.2f}; held out "
                f"{row['held_bare']:.2f} -> {row['held_after']:.2f}",
                flush=True,
            )
    judged = [r for r in read(RESULT) if int(r["case"]) >= FIRST_JUDGED]
    print(*summary(judged), sep="\n")


if __name__ == "__main__":
    main()
