"""Forces that nobody declared, hidden in machines whose truth is known.

    python -m benchmarks forces --machine pendulum --kind single
    python -m benchmarks forces --summary

Machines are in ``machines.py``. single: one force of the dictionary, of a size at which
the refitted bare model misses by a chi-square of 40 to 2,000 over its degrees of
freedom; forms that parameters or the drive absorb are drawn again. outside: a force
that is in no dictionary (a magnet, a bump, friction in two zones, a spring that
saturates), or a delay of the drive. clean: none. magnet: sin 2q in the pendulum, with
generic effects of its actuators and sensors besides. Seeds are the numbers of cases;
those below 1,000 are for tuning, and nothing may be tuned on those from 2,000 on.

Of 16 trials six are held out, which only the stand-in is told by, and the errors before
and after. Simulated trials are those of the library and the verdict; held-out errors
and their simulations come after.

Resumable: a case that stands in the CSV is not run again. Give each command a core of
its own (OMP_NUM_THREADS=1).

The table of verdicts over hidden forces.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.criticism.intervals import rate
from benchmarks.forces.hidden import FITTED, HELD_OUT, NUM_TRIALS, Hidden, draw
from benchmarks.forces.machines import MACHINES, Machine, machine
from benchmarks.rows import benchmark
from sbi_active.criticism import (
    AugmentedSimulator,
    Criticism,
    Effect,
    Trials,
    generic_effects,
)
from sbi_active.criticism.data import Role
from sbi_active.criticism.effects.effect import Context
from sbi_active.criticism.forces import force_effects
from sbi_active.criticism.forces.dictionary import FORMS
from sbi_active.criticism.results import Tracing
from sbi_active.display.table import Table

Row = dict[str, str]


def family_of(name: str) -> str:
    """Return the family of an effect of the dictionary by its name."""
    form, _, joint = name.partition(" of ")
    if " on " in joint:
        return f"coupling with {joint.split(' on ')[1]}"
    return f"force in {FORMS[form][0]} of {joint}"


def _falls(row: Row) -> bool:
    return float(row["held_after"]) < float(row["held_bare"])


def _rises(row: Row) -> bool:
    return float(row["held_after"]) > float(row["held_bare"]) * 1.0001


MEASURES: dict[str, list[tuple[str, Callable[[Row], bool]]]] = {
    "single": [
        ("right family", lambda r: family_of(r["form"]) == r["family"]),
        ("right form on top", lambda r: r["verdict"] == r["form"]),
        ("truth in the 95 % set", lambda r: r["form"] in r["set"].split(" | ")),
        ("called a stand-in", lambda r: bool(r["stand_in"])),
        ("withdrawn", lambda r: r["refuted"] == "1"),
        ("held-out error falls", _falls),
    ],
    "outside": [
        ("held-out error falls", _falls),
        ("called a stand-in", lambda r: bool(r["stand_in"])),
        ("called a stand-in, or nothing named", lambda r: is_flagged(r)),
        ("error rises, and no stand-in", lambda r: _rises(r) and not is_flagged(r)),
        ("error rises with a stand-in", lambda r: _rises(r) and is_flagged(r)),
    ],
    "clean": [("something named", lambda r: r["verdict"] != "none")],
    "magnet": [
        ("a force in q", lambda r: r["family"] == "force in q of hinge"),
        ("held-out error falls", _falls),
    ],
}


def is_flagged(row: Row) -> bool:
    """Return whether the verdict says that nothing declared explains the trials."""
    withdrawn = row["refuted"] == "1"
    return bool(row["stand_in"]) or withdrawn or row["verdict"] == "unexplained"


def summary(rows: Sequence[Row]) -> str:
    """Return the lines of the table, machines apart and together."""
    machines = [*dict.fromkeys(r["machine"] for r in rows)]
    lines = []
    for kind, measures in MEASURES.items():
        for name, hit in measures:
            parts = [[r for r in rows if r["machine"] == m] for m in machines]
            cells = []
            for part in parts:
                own = [hit(r) for r in part if r["kind"] == kind]
                cells.append(f"{sum(own)}/{len(own)}")
            every = [hit(r) for r in rows if r["kind"] == kind]
            lines.append((f"{kind}: {name}", *cells, rate(every)))
    header = ("measure", *machines, "all")
    lines = Table(header, lines).markdown().splitlines()
    for name in machines:
        own = [r for r in rows if r["machine"] == name]
        trials, scored, seconds = (
            np.array([float(r[column]) for r in own])
            for column in ("simulated_trials", "scored_trials", "cpu_seconds")
        )
        lines.append(
            f"\n{name}: {np.median(trials):,.0f} simulated trials and "
            f"{np.median(seconds):.0f} CPU s a verdict in the median, "
            f"{trials.max():,.0f} and {seconds.max():.0f} at most; held-out errors "
            f"take {np.median(scored):,.0f} more"
        )
    return "\n".join(lines)


RESULT = Path(__file__).parent / "result.csv"
#: Level of the set of effects that is to hold the truth.
LEVEL = 0.95
#: Posterior draws behind a prediction of held-out trials.
NUM_DRAWS = 50


def run_case(name: str, kind: str, number: int) -> dict[str, object]:
    """Hide a force, close the loop, and return the row of the results."""
    own = machine(name)
    generator = torch.Generator().manual_seed(number)
    action = own.draw_actions(NUM_TRIALS, generator)
    theta = own.draw_theta(generator)
    num = own.num_simulated
    begin = time.process_time()
    effects = _library(own, action, number)
    spent, dictionary = time.process_time() - begin, own.num_simulated - num
    hidden = draw(kind, own, effects, theta, action, generator)
    clean = hidden.respond(own, theta, action)
    noise = torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    trials = _trials(own, action, clean + torch.as_tensor(own.sd) * noise)
    num, begin = own.num_simulated, time.process_time()
    if kind == "magnet":
        effects = effects + generic_effects(own.model, trials.fit, prior=own.prior)
    loop = Criticism(own.model, own.prior, trials, effects=effects, seed=number)
    tracing = loop.trace()
    simulated = dictionary + own.num_simulated - num
    seconds = spent + time.process_time() - begin
    evaluation = loop.evaluate()
    judged = loop.judged(evaluation)
    scored = dictionary + own.num_simulated - num - simulated
    p = _families(effects, tracing)
    top = max(p, key=p.__getitem__) if tracing.chosen else ""
    held = [*HELD_OUT]
    before, after = (
        _held_out(own, loop, names, action[held], clean[held])
        for names in ((), judged.chosen)
    )
    return {
        "form": hidden.name,
        "verdict": tracing.verdict,
        "family": top,
        "set": " | ".join(_set(tracing.probabilities)),
        "stand_in": "; ".join(judged.stand_in),
        "refuted": int(judged.refuted is not None),
        "held_bare": before,
        "held_after": after,
        "simulated_trials": simulated,
        "scored_trials": scored,
        "cpu_seconds": seconds,
    }


def _library(own: Machine, action: Tensor, number: int) -> list[Effect]:
    blank = Hidden().respond(own, torch.tensor([own.low]).double(), action)
    trials = _trials(own, action, blank)
    return force_effects(
        *(own.model, own.prior, trials),
        joints=own.joints,
        slides=own.slides,
        seed=number,
    )


def _trials(own: Machine, action: Tensor, x: Tensor) -> Trials:
    role: list[Role] = ["fit" if k in FITTED else "held out" for k in range(NUM_TRIALS)]
    return Trials(action, x, role=role, sample_times=own.model.sample_times)


def _families(effects: list[Effect], tracing: Tracing) -> dict[str, float]:
    """Return the probability of each family of effects, by any set."""
    families = {e.name: str(e.family) for e in effects}
    p: dict[str, float] = {}
    for key, value in tracing.probabilities.items():
        for family in {families[n] for n in key.split(" + ") if n in families}:
            p[family] = p.get(family, 0.0) + value
    return p


def _set(probabilities: dict[str, float]) -> list[str]:
    found, total = [], 0.0
    for name, p in probabilities.items():
        found.append(name)
        total += p
        if total >= LEVEL:
            break
    return found


def _held_out(
    own: Machine, loop: Criticism, names: tuple[str, ...], action: Tensor, clean: Tensor
) -> float:
    """Return the rms error of the mean prediction, in sensor deviations."""
    effects = [e for e in loop.effects if e.name in names]
    model = AugmentedSimulator(own.model, effects, next_index=NUM_TRIALS)
    key = " + ".join(names) or "none"
    draws = torch.from_numpy(loop.trace().evidences[key].draws)[:NUM_DRAWS]
    num = len(draws)
    theta, phi = model.split(draws.repeat_interleave(len(action), 0))
    context = Context(torch.tensor(HELD_OUT).double().repeat(num))
    x = model.evaluate(theta, phi, action.repeat(num, 1), context=context).double()
    scaled = (x.reshape(num, *clean.shape).mean(0) - clean) / torch.as_tensor(own.sd)
    return float((scaled**2).mean().sqrt())


main = benchmark(
    RESULT,
    run_case,
    summary,
    skip=lambda machine, kind, case: kind == "magnet" and machine != "pendulum",
    machine=MACHINES,
    kind=("single", "outside", "clean", "magnet"),
    case=range(2_000, 2_040),
)
