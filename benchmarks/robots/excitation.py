"""Chosen excitation against chirps: how long a robot must move for the same intervals.

    python -m benchmarks robots.excitation --machine arm --cases 2000 2005
    python -m benchmarks robots.excitation --machine leg --cases 2000 2005
    python -m benchmarks robots.excitation --summary

A two-link arm and one leg of the Go2 (whose files are looked for beside the project, or
at GO2_IN_AIR) with their drives; damping, armature and dry friction of each joint, and
the mass of the last link, are unknown. Truth is simulated: parameters from the middle
half of the prior, encoders with white noise of 1 mrad at 50 Hz.

*Chirps* are those of common practice: every joint sweeps from 0.1 to 10 Hz in 20 s, all
at once, three times over (60 s), with the largest amplitude that keeps the limits of
position, speed and torque at parameters of the prior.
*Chosen*: signals of 2.4, 5.8, 5.8 and 5.8 s, one after the other: what the first tells
is enough for the limits to permit larger ones. Each is one of some 150: 100 random ones
(a chirp or a multisine for each joint, about centers of their own) and 52 plain ones,
in which all joints do the same in one of 13 bands; with the drives' gains as they are
or a quarter of that, and as large as the same limits permit. The first is the one that
tells most under the prior, by the Gauss-Newton information. Since every deviation is
to be at most that of the chirps, the others are those by which the largest, in units
of the chirps', is predicted to come down most: under the belief of the time, and if
the best other of the pool is played in all the time that is left.
*Random*: of 2.4, 8.7 and 8.7 s, each the first of such a pool in a random order. Four
draws of the belief say what the limits permit; the signal that is played is made
smaller until it keeps them, less a margin of 3 %, at 1,000 draws. Every belief is that
of ``identify`` from the simulated recordings.

Recorded: standard deviations of all parameters after each, whether 90 % intervals
cover, and whether all signals so far kept the limits at 1,000 other draws of the
beliefs that they were chosen by. Seeds below 1000 tune, those from 2000 on judge.
Resumable.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.robots.machines import go2_leg
from benchmarks.robots.models import ARM
from benchmarks.robots.signals import FACTORS, SHARE, Played, largest, plain, scaled
from benchmarks.rows import benchmark, column, grouped
from sbi_active import DiscreteActions, InformationGainDesigner
from sbi_active.actions import SignalActions
from sbi_active.criticism import Trials, identify
from sbi_active.display.table import Table
from sbi_active.mujoco import MotionLimits, from_mjcf
from sbi_active.mujoco.models.spec import mujoco
from sbi_active.mujoco.robot import Robot
from sbi_active.seeding import derive_seed, forked_generators, row_seeds

RESULT = Path(__file__).parent / "results" / "excitation.csv"

NOISE, RATE, GRID = 0.001, 50.0, 200.0  # rad; Hz of encoders and of goals
SWEEP, SWEEPS = 20.0, 3  # s
LENGTHS = {"chosen": (2.4, 5.8, 5.8, 5.8), "random": (2.4, 8.7, 8.7)}  # s
NUM_DRAWN, NUM_SAMPLES, NUM_PLANE = 100, 64, 16
FEW, MANY, MARGIN = 4, 1_000, 0.97  # draws that a pool and a signal have to keep
SOFT = 0.25  # of a drive's stiffness, in the second model
LEVEL = 0.9


@dataclass(frozen=True)
class Machine:
    """A robot with drives, and what it may do.

    Attributes:
        spec: Makes an ``MjSpec``.
        joints: Names, in the order of the drives.
        drives: Actuators, whose inputs are goals, rad.
        last: Body whose mass is unknown.
        center: Of each joint's range of goals, rad.
        reach: Half of it.
        bounds: Of damping, armature, dry friction and mass.
        speed: Largest, rad/s.
        torque: Largest, N m.
    """

    spec: Callable[[], Any]
    joints: tuple[str, ...]
    drives: tuple[str, ...]
    last: str
    center: tuple[float, ...]
    reach: tuple[float, ...]
    bounds: tuple[tuple[float, float], ...]
    speed: float = 8.0
    torque: float = 20.0

    def parameters(self) -> dict[str, tuple[float, float, str]]:
        """Return the unknown ones, with their bounds and places."""
        found, (*of_joint, mass) = {}, self.bounds
        fields = {"damping": "damping", "armature": "armature"}
        fields |= {"friction": "frictionloss"}
        for joint in self.joints:
            short = joint.removeprefix("FL_").removesuffix("_joint")
            for (what, field), ends in zip(fields.items(), of_joint, strict=True):
                found[f"{short} {what}"] = (*ends, f"{joint}.{field}")
        return found | {"mass": (*mass, f"{self.last}.mass")}


MACHINES = {
    "arm": Machine(
        lambda: mujoco.MjSpec.from_string(ARM),
        joints=("shoulder", "elbow"),
        drives=("shoulder servo", "elbow servo"),
        last="lower",
        center=(0.0, 0.0),
        reach=(0.8, 1.2),
        bounds=((0.0, 1.0), (0.0, 0.1), (0.0, 1.0), (0.2, 1.0)),
    ),
    "leg": Machine(
        go2_leg,
        joints=("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"),
        drives=("FL_hip", "FL_thigh", "FL_calf"),
        last="FL_calf",
        center=(0.0, 0.9, -1.8),
        reach=(0.4, 0.5, 0.6),
        bounds=((0.0, 2.0), (0.0, 0.1), (0.0, 1.5), (0.1, 0.5)),
    ),
}


@cache
def robot_of(name: str, seconds: float) -> Robot:
    """Return a robot whose trials have a length, with its actions."""
    machine = MACHINES[name]
    num = len(machine.joints)
    grid = torch.arange(0, seconds, 1 / GRID, dtype=torch.float64)
    space = SignalActions(
        Played(machine.drives, machine.center, machine.reach),
        [0.0, SHARE[0], -1.0, 0.0, 0.0] * num,
        [1.0, SHARE[1], 1.0, 1.0, 1.0] * num,
        input_times=grid,
    )
    return from_mjcf(
        [_spec(machine), _spec(machine, SOFT)],
        machine.parameters(),
        inputs=space,
        actions=DiscreteActions([0.0, 1.0], names=["model"]),
        sensors=[*machine.joints],
        times=np.arange(1 / RATE, seconds, 1 / RATE),
        noise=NOISE,
        start=dict(zip(machine.joints, machine.center, strict=True)),
    )


def _spec(machine: Machine, softness: float = 1.0) -> Any:
    """Return a spec whose drives are softer, as well damped as they are."""
    spec = machine.spec()
    for drive in spec.actuators:
        drive.gainprm[0] *= softness
        drive.biasprm[1] *= softness
        drive.biasprm[2] *= softness**0.5
    return spec


def limits_of(
    name: str, robot: Robot, belief: Any = None, *, share: float = 1.0, **draws: int
) -> MotionLimits:
    """Return the limits of a machine's motion, or a share of them."""
    machine = MACHINES[name]
    ends = zip(machine.joints, machine.center, machine.reach, strict=True)
    reach = 1.1 * share
    return MotionLimits(
        robot,
        position={j: (c - reach * r, c + reach * r) for j, c, r in ends},
        velocity=dict.fromkeys(machine.joints, share * machine.speed),
        torque=dict.fromkeys(machine.drives, share * machine.torque),
        belief=belief,
        **{"num_draws": FEW, **draws},
    )


def safe(name: str, robot: Robot, belief: Any, action: Tensor) -> tuple[Tensor, bool]:
    """Return a signal that keeps the limits at many draws of the belief.

    Returns:
        The signal, made smaller where it has to be, shape (1, action_dim); and whether
        it keeps the limits at as many other draws.
    """
    permitted = limits_of(name, robot, belief, share=MARGIN, num_draws=MANY)
    # Few draws permitted this size: what many permit is near it, so from there down.
    sizes = (scaled(action, torch.tensor([k])) for k in range(len(FACTORS)))
    action = next(own for own in sizes if permitted(own))
    other = limits_of(name, robot, belief, num_draws=MANY, seed=1)
    return action, bool(other(action).all())


def chirps(name: str) -> Tensor:
    """Return the largest permitted chirp of all joints, shape (1, action_dim)."""
    each = [0.0, SHARE[1], 0.0, 0.0, 1.0]
    action = torch.tensor([each * len(MACHINES[name].joints) + [0.0]])
    return largest(action, limits_of(name, robot_of(name, SWEEP)))


def permitted_pool(name: str, robot: Robot, belief: Any, seed: int) -> Tensor:
    """Return signals as large as the limits permit, in a random order."""
    assert robot.actions is not None
    drawn = robot.actions.sample((NUM_DRAWN,), seed=derive_seed(seed, "pool"))
    pool = largest(
        torch.cat([drawn, plain(len(MACHINES[name].joints))]),
        limits_of(name, robot, belief),
    )
    with forked_generators(seed):
        return pool[torch.randperm(len(pool))]


def nearest(
    robot: Robot, belief: Any, pool: Tensor, wanted: Tensor, num_left: int
) -> Tensor:
    """Return the signal by which all deviations come nearest to those wanted.

    What a signal tells is the Gauss-Newton information of a plane through outcomes at
    draws of the belief.

    Args:
        robot: Robot that plays the signals.
        belief: Belief of the time.
        pool: Signals, shape (n, action_dim).
        wanted: Standard deviations, shape (theta_dim,).
        num_left: Number of signals still to come, this one included.

    Returns:
        The one after which, and after the best other in all signals that then follow,
        the largest deviation in units of that wanted is least, shape (1, action_dim).
    """
    theta, simulator = belief.quick_sample(NUM_PLANE, seed=0), robot.simulator
    assert simulator.noise is not None
    unit = ((theta - theta.mean(0)) / wanted).double()
    known = torch.cov((belief.draws / wanted).double().T).inverse()
    told = torch.empty(len(pool), *known.shape, dtype=torch.float64)
    for k, own in enumerate(pool.split(1)):
        mean = simulator.mean(theta, own.expand(len(theta), -1)).double()
        y = simulator.noise.whiten(mean).flatten(1)
        slope = torch.linalg.lstsq(unit, y).solution
        told[k] = slope @ slope.T
    all_told = known + told + (num_left - 1) * told[:, None]
    variance = torch.linalg.inv(all_told).diagonal(dim1=-2, dim2=-1)
    return pool[variance.amax(-1).amin(0).argmin()][None]


def recorded(parts: Sequence[tuple[Any, Tensor]], theta: Tensor, seed: int) -> Trials:
    """Return trials of simulated robots, each of which played some actions."""
    each = enumerate(len(action) for _, action in parts)
    seeds = torch.cat([row_seeds(derive_seed(seed, k), num) for k, num in each])
    trials = [(robot, own) for robot, action in parts for own in action.split(1)]
    inputs = [robot.actions.inputs(own.double()) for robot, own in trials]
    x = [
        robot.simulator.noise.sample(robot.simulator.mean(theta, own).double(), rows)[0]
        for (robot, own), rows in zip(trials, seeds.split(1), strict=True)
    ]
    return Trials(
        torch.cat([own for _, own in trials]),
        x,
        sample_times=[robot.simulator.sample_times for robot, _ in trials],
        inputs={name: [u[name][0] for u in inputs] for name in inputs[0]},
        input_times=[robot.actions.input_times for robot, _ in trials],
    )


def score(name: str, case: int) -> list[dict[str, object]]:
    """Return a row for the chirps, the chosen and the random signals."""
    robot = robot_of(name, LENGTHS["chosen"][-1])
    with forked_generators(case, "truth"):
        low, high = robot.prior.base_dist.low, robot.prior.base_dist.high
        theta = low + (high - low) * (0.25 + 0.5 * torch.rand(1, len(low)))
    rows = []

    def keep(arm: str, belief: Any, seconds: float, begin: float, *kept: bool) -> None:
        ends = np.array([*belief.interval(LEVEL).values()])
        true = theta[0].numpy()
        rows.append(
            {
                "arm": arm,
                "seconds": seconds,
                "sds": json.dumps([float(f"{v:.4g}") for v in belief.draws.std(0)]),
                "covered": int(((ends[:, 0] <= true) & (true <= ends[:, 1])).sum()),
                "kept": int(all(kept)),
                "cpu_seconds": round(time.process_time() - begin, 1),
            }
        )

    begin, sweeps = time.process_time(), robot_of(name, SWEEP)
    own = recorded([(sweeps, chirps(name).repeat(SWEEPS, 1))], theta, case)
    belief = identify(sweeps.simulator, sweeps.prior, own, seed=case)
    keep("chirps", belief, SWEEP * SWEEPS, begin)
    wanted = belief.draws.std(0)
    for arm, lengths in LENGTHS.items():
        begin, belief = time.process_time(), robot.prior
        parts: list[tuple[Robot, Tensor]] = []
        kept: list[bool] = []
        for k, seconds in enumerate(lengths):
            played = robot_of(name, seconds)
            seed = derive_seed(case, k)
            pool = permitted_pool(name, played, belief, seed)
            if arm == "chosen" and k:
                pool = nearest(played, belief, pool, wanted, len(lengths) - k)
            elif arm == "chosen":
                designer = InformationGainDesigner(
                    DiscreteActions(pool), num_samples=NUM_SAMPLES, estimator="linear"
                )
                own = played.simulator
                design = designer.select(None, own, belief=belief, seed=seed)
                pool = design.action[None]
            signal, is_kept = safe(name, played, belief, pool[:1])
            parts.append((played, signal))
            kept.append(is_kept)
            trials = recorded(parts, theta, case)
            belief = identify(robot.simulator, robot.prior, trials, seed=case)
            keep(arm, belief, sum(lengths[: k + 1]), begin, *kept)
    return rows


def summary(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the table: deviations beside those of the chirps."""
    header = ["machine", "cases", "signals", "s"]
    header += ["deviations, of the chirps' in 60 s: median, largest"]
    header += ["deviations at most the chirps'", "90 % intervals that cover"]
    header += ["limits kept", "CPU s"]
    lines = []
    base = {
        (r["machine"], r["case"]): np.array(json.loads(r["sds"]))
        for r in rows
        if r["arm"] == "chirps"
    }
    groups = grouped(rows, "machine", "arm", "seconds")
    for name, arm, seconds in sorted(groups, key=lambda key: [*MACHINES].index(key[0])):
        some = groups[name, arm, seconds]
        ratio = np.array([json.loads(r["sds"]) / base[name, r["case"]] for r in some])
        inside = sum(int(r["covered"]) for r in some)
        sizes = f"{np.median(ratio):.2f}, {ratio.max():.2f}"
        held = (f"{n} of {ratio.size}" for n in (int((ratio <= 1).sum()), inside))
        kept = f"{sum(int(r['kept']) for r in some)} of {len(some)}"
        cost = f"{np.median(column(some, 'cpu_seconds')):.0f}"
        place = (name, len(some), arm, f"{float(seconds):g}")
        lines.append((*place, sizes, *held, kept, cost))
    return Table(header, lines).markdown()


main = benchmark(RESULT, score, summary, machine=MACHINES, case=range(2000, 2005))
