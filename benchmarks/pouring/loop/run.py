"""The closed loop on images: hidden, clean, and a material that is not in the model.

    python -m benchmarks pouring.loop --bank FOLDER --kind hidden clean material
    python -m benchmarks pouring.loop --summary

"hidden" and "clean": ten sets each, of twelve pours of 100 cubes at three actions (two
pours of each are fitted, two are held out), with parameters from the prior; hidden sets
have one effect, each of the nine in turn, one to two and a half of its prior's
deviations strong. "material": pours of beads and gravel, which no parameter of the
eight-parameter model reproduces, three trials each. Nobody poured these either: they
are simulated with another shape, a spread of sizes and undeclared effects.

The images are PyBullet's own; what the loop simulates is an emulator of a few numbers
of them (``emulator``). Resumable; one row a set.

What the closed loop said of images, from the rows of a run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.loop.emulator import Emulator, pictures_numbers, side_of
from benchmarks.pouring.loop.worlds import World, get_world
from benchmarks.rounds import Rows
from benchmarks.rows import read, resumed
from sbi_active import DiscreteActions
from sbi_active.criticism import Context, Criticism, Report, Trials
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of


def summarize(rows: Rows) -> str:
    """Return one line a set and the counts."""
    if not rows:
        return "no sets yet"
    table = [
        [
            f"{r['kind']} {r['case']}",
            r["truth"] + (f" {float(r['phi']):.3g}" if r["kind"] == "hidden" else ""),
            r["verdict"],
            f"{float(r['log_bayes']):.1f}",
            f"{float(r['p_truth']):.2f}" if r["kind"] == "hidden" else "",
            f"{float(r['rmse_before']):.2f} -> {float(r['rmse_after']):.2f}",
            f"{float(r['cpu_seconds']):.0f}",
        ]
        for r in rows
    ]
    header = ["set", "truth", "verdict", "log Bayes factor", "P(truth)"]
    header += ["held-out error, sd", "CPU s"]
    lines = [Table(header, table).text(), ""]
    hidden, clean, material = (
        [r for r in rows if r["kind"] == kind]
        for kind in ("hidden", "clean", "material")
    )
    if clean:
        alarms = sum(r["alarm"] == "True" for r in clean)
        lines.append(f"clean sets: {alarms} false alarms of {len(clean)}")
    if hidden:
        found = [r for r in hidden if r["alarm"] == "True"]
        top = sum(r["place"] == "1" for r in found)
        ratio = [float(r["rmse_after"]) / float(r["rmse_before"]) for r in found]
        middle = f"{np.median(ratio):.2f}" if ratio else "-"
        lines.append(
            f"hidden sets: {len(found)} of {len(hidden)} alarms; the effect, or one no "
            f"action separates from it, first in {top} of these; error after / before, "
            f"median {middle}"
        )
    if material:
        said = sum("unexplained" in r["verdict"] for r in material)
        alarms = sum(r["alarm"] == "True" for r in material)
        missed = sum(r["verdict"] == "none" for r in material)
        stand_ins = [r for r in material if r["verdict"] not in ("unexplained", "none")]
        ratio = [float(r["rmse_after"]) / float(r["rmse_before"]) for r in stand_ins]
        left = f", which leave {ratio_range(ratio)} of the error" if ratio else ""
        lines.append(
            f"material: {alarms} of {len(material)} alarms; 'unexplained' in {said}, "
            f"stand-ins in {len(stand_ins)}{left}; 'none' in {missed}"
        )
    return "\n".join(lines)


def ratio_range(ratio: list[float]) -> str:
    """Return the median and the range of some shares."""
    return f"{np.median(ratio):.2f} ({min(ratio):.2f} to {max(ratio):.2f})"


RESULTS = Path(__file__).parents[1] / "results"
KINDS = ("hidden", "clean", "material")
WORLD_OF = {"hidden": "cubes", "clean": "cubes", "material": "material"}
CASES = {"hidden": 10, "clean": 10, "material": 6}
FIRST = {"hidden": 2_700, "clean": 2_750, "material": 2_520}  # seeds
BARE = "compared"  # part without effects, of material.bank, at one of the actions
NUM_POURS = 2  # of an action that are fitted, and as many that are held out
STRONG = 1.0, 2.5  # of the prior's deviation


@cache
def emulator(bank: Path, name: str) -> Emulator:
    """Return the emulator of a world from its bank.

    Args:
        bank: Folder of the worlds' pours, with those that compare materials in its
            ``compared``, if it has any.
        name: Of the world.
    """
    world = get_world(name)
    rows = read_bank(bank, name)
    theta, action, poses = [rows.theta], [rows.action], [rows.poses]
    effects = {key: [value] for key, value in rows.effects.items()}
    if name == "material" and (bank / BARE).exists():
        more = read_bank(bank, BARE)
        theta.append(more.theta)
        action.append(more.action)
        poses.append(more.poses)
        for values in effects.values():
            values.append(np.zeros(len(more)))
    particles, every = world.task.pours.particles, np.concatenate(poses)
    x = np.concatenate(
        [
            pictures_numbers(images_of(some, particles), side_of(world))
            for some in np.array_split(every, max(1, len(every) // 100))
        ]
    )
    strengths = {key: np.concatenate(values) for key, values in effects.items()}
    rows_of_both = torch.cat(theta), torch.cat(action)
    return Emulator.fit(world, *rows_of_both, strengths, x, averaged=NUM_POURS)


def truth_of(world: World, kind: str, case: int) -> tuple[Tensor, str, float]:
    """Return theta (3,), the name of the hidden effect and its strength."""
    effects = world.task.effects()
    effect = effects[case % len(effects)]
    with forked_generators(FIRST[kind] + case, "truth"):
        theta = world.task.prior.sample(torch.Size([1]))[0]
        size = STRONG[0] + (STRONG[1] - STRONG[0]) * float(torch.rand(()))
        sign = 1.0 if float(torch.rand(())) < 0.5 else -1.0
    if kind == "clean":
        return theta, "none", 0.0
    draws = effect.declared_draws()
    sign = sign if bool((draws < 0).any()) else 1.0
    return theta, effect.name, sign * size * float(draws.square().mean().sqrt())


def pour_set(kind: str, case: int) -> tuple[Tensor, Tensor, list[Any], dict[str, Any]]:
    """Return actions (n, 3), images (n, 22500), roles and the truth of a set."""
    world = get_world(WORLD_OF[kind])
    action = world.actions.repeat_interleave(2 * NUM_POURS, 0)
    role = (["fit"] * NUM_POURS + ["held out"] * NUM_POURS) * len(world.actions)
    seed = FIRST[kind] + case
    seeds = torch.tensor([derive_seed(seed, "pour", k) for k in range(len(action))])
    if kind == "material":
        material = ("beads", "gravel")[case % 2]
        task: Any = get_task("pouring_real", material=material)
        pours = zip(action, seeds.tolist(), strict=True)
        images = torch.stack([task.real_system(a, seed=s) for a, s in pours])
        return action, images, role, {"theta": "", "truth": material, "phi": ""}
    theta, name, phi = truth_of(world, kind, case)
    images = poured(world, theta, action, seeds, {name: phi} if phi else {})
    told = " ".join(f"{v:.4g}" for v in theta.tolist())
    return action, images, role, {"theta": told, "truth": name, "phi": phi}


def poured(
    world: World,
    theta: Tensor,
    action: Tensor,
    seeds: Tensor,
    strengths: dict[str, float],
) -> Tensor:
    """Return images of pours with effects by name, shape (n, 22500)."""
    chosen = [e for e in world.task.effects() if e.name in strengths]
    keywords = {
        e.apply.names[0]: strengths[e.name]  # type: ignore[attr-defined]
        for e in chosen
        if e.hook == "dynamics"
    }
    rows = theta.expand(len(action), -1)
    images = world.task.pours.images(rows, action, seeds=seeds, **keywords)
    for effect in chosen:
        if effect.hook == "observation":
            strength = torch.full((len(action), 1), strengths[effect.name])
            context = Context(torch.arange(len(action)))
            images = effect.apply(images, strength, action, context)
    return images


def criticized(
    bank: Path, kind: str, case: int
) -> tuple[Criticism, Report, dict[str, Any]]:
    """Return the loop on a set, its report and the truth."""
    known = emulator(bank, WORLD_OF[kind])
    action, images, role, truth = pour_set(kind, case)
    near = torch.cdist(action, known.world.actions).argmin(1).tolist()
    every = [
        known.observed(image[None], k)[0] for image, k in zip(images, near, strict=True)
    ]
    trials = averaged(action, torch.stack(every), role)
    criticism = Criticism(
        known.model(),
        known.world.task.prior,
        trials,
        effects=known.effects(),
        actions=DiscreteActions(known.world.actions),
        seed=case,
    )
    return criticism, criticism.report(plan=False), truth


def averaged(action: Tensor, x: Tensor, role: list[Any]) -> Trials:
    """Return a trial for each action and role, the mean of its pours.

    What the emulator misses is the same in all pours of an action, so that they are no
    independent trials.
    """
    keys = list(dict.fromkeys(zip(map(tuple, action.tolist()), role, strict=True)))
    mean = []
    for place, own in keys:
        mine = torch.tensor([r == own for r in role])
        mean.append(x[mine & (action == torch.tensor(place)).all(1)].mean(0))
    return Trials(
        torch.tensor([place for place, _ in keys]),
        torch.stack(mean),
        role=[own for _, own in keys],
    )


def row_of(bank: Path, kind: str, case: int) -> dict[str, object]:
    """Return the row of a set."""
    start = time.process_time()
    criticism, report, truth = criticized(bank, kind, case)
    tracing, detection = criticism.trace(), criticism.detect()
    groups = criticism.equivalent()
    names = {truth["truth"]}.union(*[g for g in groups if truth["truth"] in g])
    others = {k: v for k, v in tracing.probabilities.items() if k != "none"}
    order = sorted(others, key=lambda name: -others[name])
    places = [k + 1 for k, name in enumerate(order) if name in names]
    evaluation = report.evaluation
    return {
        **truth,
        "alarm": detection.alarm,
        "log_bayes": float(detection.log_bayes_factor),
        "chi_square_p": float(detection.p_value),
        "verdict": report.verdict,
        "top": order[0] if order else "",
        "top_probability": others[order[0]] if order else 0.0,
        "p_truth": sum(tracing.probabilities.get(name, 0.0) for name in names),
        "place": min(places, default=0),
        "p_unexplained": sum(v for k, v in others.items() if "unexplained" in k),
        "rmse_before": error(evaluation.before) if evaluation else float("nan"),
        "rmse_after": error(evaluation.after) if evaluation else float("nan"),
        "cpu_seconds": time.process_time() - start,
    }


def error(by_metric: dict[str, Any]) -> float:
    """Return the error over all scored pours, in deviations of the noise."""
    return float(np.sqrt(np.mean(by_metric["rmse"] ** 2)))


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        bank: Folder of pours.
        kind: Kind of cases; all by default.
        results: Folder of the results.
        summary: Whether to run nothing, and print the table of the rows.
    """

    bank: Path | None = None
    kind: Annotated[Sequence[str], KINDS] = (*KINDS,)
    results: Path = RESULTS
    summary: bool = False


def main(arguments: Settings) -> None:
    """Run what is asked for and is not there yet, and print the table."""
    path = arguments.results / "loop.csv"
    if not arguments.summary:
        if arguments.bank is None:
            raise SystemExit(
                "expected --bank FOLDER; got none; make one, see worlds.py"
            )
        jobs = [(kind, case) for kind in arguments.kind for case in range(CASES[kind])]
        own = partial(row_of, arguments.bank)
        resumed(path, ["kind", "case"], jobs, own)
    print(summarize(read(path)))
