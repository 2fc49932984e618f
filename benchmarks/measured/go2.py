"""The Go2's legs: what rigid legs with friction lack, from one record in the air.

    python -m benchmarks measured.go2 --data DIR
    python -m benchmarks measured.go2 --data DIR --legs FL --figures docs/measured_go2

``DIR`` holds ``go2_in_air.xml`` and ``trajectory.csv``: 13 triangles of all joints,
from 3.0 to 0.6 s. Each leg is fitted to the first eight and judged on the five faster
ones, in one free run of the whole record from its first reading on. Stages of each
leg, which are added to ``results/go2.json`` unless they are there:

- ``FL``: the engineer's model, with armature, viscous damping, dry friction and a
  torque scale of each joint, against what ``mjcf_effects`` lists of the knee, its motor
  and its encoder, and the tilt of the base; of the other legs against four of these.
- ``FL, removed``: against these four without the effects that the first stage adopted.
- ``FL, rigid legs``: armature and the PD law alone, in rounds: what a round says that
  helps is in the simulator of the next, until nothing does.
- ``FL, forces``: the library of generalized forces on the knee, with free shapes.

Beside the verdicts plain least squares, given the same effects.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from benchmarks.criticism.scores import counted
from benchmarks.measured.go2_least_squares import fit_leg
from benchmarks.measured.go2_leg import DATA, LEGS, Leg, read_leg, usual_parameters
from benchmarks.measured.go2_tables import tables
from benchmarks.measured.record_verdicts import center
from sbi_active.criticism import Criticism, Effect
from sbi_active.criticism.report.summary import misfit_line
from sbi_active.criticism.results import ModelKey, Tracing
from sbi_active.mujoco import Robot, force_effects, mjcf_effects

__all__ = ["judge", "main"]

RESULT = Path(__file__).parent / "results" / "go2.json"
ROUNDS = 5
#: Of a joint.
KINDS = ("friction loss by *", "static friction", "quadratic damping", "*stiffness")
KINDS += ("zero offset", "sensor bias", "sensor delay")
#: The same for the other legs, and with an effect removed: what was near on the first.
FEW_KINDS = ("friction loss by *", "static friction")


def judge(
    leg: Leg,
    library: Callable[[Robot], Sequence[Effect]],
    *,
    rigid: bool = False,
    rounds: int = 1,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the row of one verdict, or of some in turn.

    Args:
        leg: That is fitted.
        library: Effects of a robot.
        rigid: Start from armature and the PD law alone.
        rounds: Verdicts at most, each with what helped before in the simulator.
        seed: Of all draws.
    """
    parameters = usual_parameters(leg, rigid=rigid)
    robot = leg.robot(parameters, leg.triangles())
    begin = time.process_time()
    effects = [*library(robot)]
    model, count = counted(robot.simulator)
    prior, found, before, adopted = robot.prior, [], None, []
    assert robot.trials is not None
    for _ in range(rounds):
        left = [e for e in effects if e not in adopted]
        # The report's residuals, each trial predicted from those before, would take as
        # long as the verdict.
        loop = Criticism(
            *(model, prior, robot.trials),
            effects=left,
            thin=False,  # readings are chosen by hand
            seed=seed,
        )
        tracing = loop.trace()
        adopted += [e for n in tracing.chosen for e in effects if e.name == n]
        values = center(tracing.evidences[str(ModelKey(tracing.chosen))])
        run = leg.free_run(parameters, adopted, values)[0]
        row = _row(tracing) | {
            "values": values[0].tolist(),
            "after": leg.errors(run),
        }
        if before is None:
            bare = center(tracing.evidences[str(ModelKey())])
            before = leg.errors(leg.free_run(parameters, [], bare)[0])
            row |= {"before": before, "bare values": bare[0].tolist()}
        found.append(row)
        if not tracing.chosen:
            break
        model, prior = loop.add()
    last = {"values": found[-1]["values"], "after": found[-1]["after"]}
    row = {**found[0], **last, "helps": [e.name for e in adopted]}
    if rounds > 1:
        row["rounds"] = found
    return row | {
        "cpu_seconds": time.process_time() - begin,
        "trial_simulations": count(),
    }


def _row(tracing: Tracing) -> dict[str, Any]:
    """Return a verdict as plain figures."""
    misfit, helps = tracing.misfit, tracing.chosen
    evidence = tracing.evidences[str(ModelKey(helps))]
    cause = tracing.inclusion if misfit is None else misfit.cause
    describe = {e.name: e.describe for e in tracing.estimates}
    return {
        "verdict": tracing.verdict,
        "line": "Verdict: "
        + (tracing.verdict if misfit is None else misfit_line(tracing.verdict, misfit)),
        "named": [*(helps if misfit is None else misfit.named)],
        "helps": [*helps],
        "describe": [describe[name] for name in helps],
        "cause": {name: float(cause.get(name, 0.0)) for name in tracing.inclusion},
        "better": {} if misfit is None else dict(misfit.better),
        "log_evidence": {k: e.log_evidence for k, e in tracing.evidences.items()},
        "parameters": {
            name: [float(z.mean()), float(z.std())]
            for name, z in zip(evidence.names, evidence.draws.T, strict=True)
        },
    }


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        data: Folder of the measured set.
        legs: Names of legs.
        stages: Names of the stages, as in 'removed', 'rigid legs'.
        out: File of the results.
        figures: Folder for the figures.
        seed: Seed of the engine.
    """

    data: Path = DATA
    legs: Annotated[Sequence[str], LEGS] = (*LEGS,)
    stages: Sequence[str] | None = None
    out: Path = RESULT
    figures: Path | None = None
    seed: int = 0


def main(arguments: Settings) -> int:
    """Run the stages that are missing from the results, and print the tables."""
    try:
        legs = [read_leg(arguments.data, name) for name in arguments.legs]
    except FileNotFoundError as error:
        print(f"{error}, as in --data DIR", file=sys.stderr)
        return 2
    rows: dict[str, Any] = {}
    if arguments.out.is_file():
        rows = json.loads(arguments.out.read_text())
    for leg in legs:
        for name, row in _stages(leg, rows, arguments):
            rows[name] = row
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
            if "line" in row:
                print(f"{name}: {row['line']}, {row['cpu_seconds']:.0f} CPU s")
            sys.stdout.flush()
    print(tables(rows))
    if arguments.figures is not None:
        from benchmarks.measured.go2_figures import draw

        for leg in legs:
            draw(rows[leg.name], leg, arguments.figures)
    return 0


def _library(
    leg: Leg, removed: Sequence[str] = (), *, few: bool = False
) -> Callable[..., list[Effect]]:
    """Return what lists the effects on the knee of the engineer's model.

    That has the torque scale of the motor already, "gain" by another name. What moves
    the body behind the joint by a second one is left out for what it costs.
    """
    joint, motor = leg.joints[-1], leg.motors[-1]
    kinds = FEW_KINDS if few else KINDS
    wanted = [*(f"{joint} {kind}" for kind in kinds), f"{motor} delay"]
    wanted += [] if few else [f"{motor} bias", "gravity tilt *"]
    return lambda robot: mjcf_effects(robot, include=wanted, exclude=removed)


def _stages(leg: Leg, rows: dict[str, Any], arguments: Any) -> Any:
    """Yield the name and the row of each stage that is missing."""
    seed, own = arguments.seed, leg.name

    def wanted(stage: str) -> bool:
        name = f"{own}, {stage}" if stage else own
        chosen = arguments.stages is None or stage in arguments.stages
        return name not in rows and (chosen or not stage)

    def judged(name: str, library: Any, **options: Any) -> Any:
        row = judge(leg, library, seed=seed, **options)
        return name, row

    if wanted(""):
        yield judged(own, _library(leg, few=own != LEGS[0]))
    helps = rows[own]["helps"]
    if wanted("least squares"):
        given = dict.fromkeys([(), (*helps,)])
        yield f"{own}, least squares", _least_squares(leg, [*given])
    if wanted("removed"):
        yield judged(f"{own}, removed", _library(leg, helps, few=True))
    if own == LEGS[0] and wanted("rigid legs"):
        every = lambda robot: mjcf_effects(robot)  # noqa: E731
        yield judged(f"{own}, rigid legs", every, rigid=True, rounds=ROUNDS)
    if own == LEGS[0] and wanted("forces"):
        knee = f"*of {leg.joints[-1]}"
        yield judged(f"{own}, forces", lambda robot: force_effects(robot, include=knee))


def _least_squares(leg: Leg, sets: Sequence[tuple[str, ...]]) -> dict[str, Any]:
    """Return fits of the engineer's model, given some sets of effects."""
    parameters = usual_parameters(leg)
    robot = leg.robot(parameters, leg.triangles())
    names = sorted({name for each in sets for name in each})
    effects = {e.name: e for e in mjcf_effects(robot, include=names)} if names else {}
    found = {}
    for each in sets:
        found[" + ".join(each) or "none"] = fit_leg(
            leg, parameters, [effects[name] for name in each]
        )
    return found
