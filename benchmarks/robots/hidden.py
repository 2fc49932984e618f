"""Effects of ``mjcf_effects`` hidden in ten public models, one at a time.

    python -m benchmarks robots.hidden --kind hidden --seeds 2000 2010
    python -m benchmarks robots.hidden --kind clean --seeds 2000 2010
    python -m benchmarks robots.hidden --summary

Of each robot of :mod:`.public` the truth has parameters of its own and one effect,
drawn with equal odds from all that ``mjcf_effects`` lists; its strength is one at which
the refitted bare model misses by a chi-square of 40 to 2,000 over its degrees of
freedom (where the null is infinite, as of a saturation, strengths are drawn until one
does). An effect that parameters absorb is drawn again. The loop gets the same list,
eight trials of 25 readings a joint, and the sensors' deviations; simulated trials are
those of its verdict.

A verdict is right if it is the effect, or if the effect stands in a group that the
verdict itself calls not separated from it: by no permitted action, or by these trials.

Rows (results/hidden.csv): seeds below 1000 are for tuning, the table is of seeds from
2000 on, and those that are there are not run again. Needs dm_control and gymnasium for
their files, and the Go2's MJCF as in :mod:`.machines`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.criticism.intervals import rate
from benchmarks.criticism.problem import counted
from benchmarks.fitting import local_fit
from benchmarks.robots.machines import sines
from benchmarks.robots.public import PUBLIC, Public
from benchmarks.rows import benchmark, column
from sbi_active.criticism import AugmentedSimulator, Criticism, Effect, Trials
from sbi_active.criticism.effects.trial_conditions import conditions_of_trials
from sbi_active.display.table import Table
from sbi_active.mujoco import from_mjcf, mjcf_effects
from sbi_active.mujoco.robot import Robot

Array = NDArray[Any]

RESULTS = Path(__file__).parent / "results/hidden.csv"
NUM_TRIALS, NUM_READINGS = 8, 25
STEP = 0.02  # of the control's grid, s
#: Chi-square over its degrees of freedom that the refitted bare model is left with.
EXCESS = 40.0, 2_000.0
TRIES = 8
#: Share of a prior's side, from its ends, where no truth is drawn.
MARGIN = 0.2


def planned(
    own: Public, rng: np.random.Generator
) -> tuple[Robot, Callable[[Array], Trials]]:
    """Return a robot, and what makes trials of x, (trials, readings, joints)."""
    inner = np.arange(0.0, own.seconds + 1e-9, STEP)
    times = np.linspace(0, own.seconds, NUM_READINGS + 1)[1:]
    robot = from_mjcf(
        own.spec(),
        own.parameters,
        sensors=[*own.read],
        times=times,
        noise=dict(own.read),
    )
    played = [sines(inner, own.drive.values(), rng).T for _ in range(NUM_TRIALS)]
    starts = {
        name: center + half * rng.uniform(-1, 1, NUM_TRIALS)
        for name, (center, half) in own.start.items()
    }
    return robot, lambda x: Trials(
        None,
        x[..., 0] if x.shape[-1] == 1 else x,
        sample_times=times,
        inputs=dict(zip(own.drive, np.stack(played, 1), strict=True)),
        input_times=inner,
        start=starts,
        channel_labels=robot.simulator.channel_names,
    )


class Truth:
    """What a robot does, with parameters and an effect.

    Args:
        robot: Of :func:`planned`.
        trials: That are run.
    """

    def __init__(self, robot: Robot, trials: Trials) -> None:
        self.robot, self.trials = robot, trials
        self.sd = torch.as_tensor(robot.simulator.noise.sd).double()  # type: ignore[union-attr]
        base = robot.prior.base_dist  # type: ignore[attr-defined]
        self.low, self.high = base.low.double(), base.high.double()

    def run(self, theta: Array, effect: Effect | None = None, phi: Any = None) -> Array:
        """Return x without noise, in deviations of it, (rows, trials, numbers).

        Args:
            theta: Shape (rows, d).
            effect: That is there.
            phi: Of one row, (phi_dim,).
        """
        simulator = self.robot.simulator
        model = AugmentedSimulator(simulator, [effect] if effect else [])
        rows = torch.arange(NUM_TRIALS).repeat(len(theta))
        own = torch.from_numpy(theta).double().repeat_interleave(NUM_TRIALS, 0)
        given = {effect.name: phi.expand(len(rows), -1)} if effect else {}
        x = model.evaluate(
            own,
            given,
            self.trials.action.double()[rows],
            context=conditions_of_trials(self.trials, rows, simulator),
        )
        x = x.double().reshape(len(theta), NUM_TRIALS, NUM_READINGS, -1) / self.sd
        return x.flatten(2).numpy()

    def excess(self, theta: Array, effect: Effect, phi: Tensor) -> float:
        """Return the chi-square that the refitted bare model is left with."""
        target = self.run(theta[None], effect, phi)[0]
        if not np.isfinite(target).all():
            return np.inf
        low, high = self.low.numpy(), self.high.numpy()
        width = high - low

        def residual(u: Array) -> Array:
            left = self.run(low + width * u) - target
            return np.nan_to_num(left.reshape(len(u), -1))

        start = (theta - low) / width
        ends = {"low": -1e-9, "high": 1 + 1e-9}
        found = local_fit(residual, start, **ends, difference=1e-4, evaluations=12)
        return 2 * float(found.cost)


def hidden_effect(
    truth: Truth, effects: Sequence[Effect], theta: Array, rng: np.random.Generator
) -> tuple[Effect, Tensor, float]:
    """Return an effect, its strength, and the excess that it makes.

    Args:
        truth: The robot and its trials.
        effects: The library.
        theta: Of the truth, shape (d,).
        rng: Of all draws.
    """
    while True:
        effect = effects[int(rng.integers(len(effects)))]
        draws = effect.declared_draws().double()
        null = effect.null_phi(1)[0]
        wanted = float(np.exp(rng.uniform(*np.log(EXCESS))))
        phi = draws[int(rng.integers(len(draws)))]
        for _ in range(TRIES):
            excess = truth.excess(theta, effect, phi)
            if EXCESS[0] <= excess <= EXCESS[1]:
                return effect, phi, excess
            if not bool(null.isfinite().all()):
                phi = draws[int(rng.integers(len(draws)))]
                continue
            factor = np.sqrt(wanted / max(excess, 1e-9)) if np.isfinite(excess) else 0.2
            phi = null + (phi - null) * float(np.clip(factor, 0.1, 5.0))
            if not bool(effect.log_prob(phi[None]).isfinite().all()):
                break
            if bool(((phi - null).abs() > 2 * (draws - null).abs().amax(0)).any()):
                break


def run_case(name: str, kind: str, seed: int) -> dict[str, object]:
    """Hide an effect, close the loop, and return the row of the results.

    Args:
        name: Of the robot.
        kind: Of ``KINDS``.
        seed: Of all draws.
    """
    rng = np.random.default_rng([seed, [*PUBLIC].index(name)])
    robot, measured = planned(PUBLIC[name], rng)
    shape = (NUM_TRIALS, NUM_READINGS, len(PUBLIC[name].read))
    trials = measured(np.zeros(shape))
    truth = Truth(robot, trials)
    share = rng.uniform(MARGIN, 1 - MARGIN, len(truth.low))
    theta = (truth.low + (truth.high - truth.low) * torch.from_numpy(share)).numpy()
    effects = mjcf_effects(robot, trials=trials)
    row: dict[str, object] = {"effect": "none", "phi": "", "excess": 0.0}
    row["library"] = len(effects)
    if kind == "hidden":
        effect, phi, excess = hidden_effect(truth, effects, theta, rng)
        x = truth.run(theta[None], effect, phi)[0]
        values = " ".join(f"{v:.6g}" for v in phi.tolist())
        row |= {"effect": effect.name, "phi": values, "excess": excess}
    else:
        x = truth.run(theta[None])[0]
    x = (x + rng.standard_normal(x.shape)).reshape(shape) * truth.sd.numpy()
    model, count = counted(robot.simulator)
    begin = time.process_time()
    loop = Criticism(model, robot.prior, measured(x), effects=effects, seed=seed)
    tracing = loop.trace()
    groups = [*tracing.equivalent, *tracing.aliases]
    stated = {n for g in groups if g & {*tracing.chosen} for n in g}
    wanted = row["effect"]
    right = tracing.verdict == wanted or wanted in stated
    return row | {
        "verdict": tracing.verdict,
        "alarm": int(loop.detect().alarm),
        "p_effect": tracing.inclusion.get(str(wanted), 0.0),
        "right": int(right),
        "simulated_trials": count(),
        "cpu_seconds": time.process_time() - begin,
    }


def summary(rows: list[dict[str, str]]) -> str:
    """Return the table, a row a robot."""
    header = ["robot", "effects listed", "named exactly", "or a stated group"]
    header += ["P of the effect > .1", "false alarms", "named in clean sets"]
    cells = []
    for name in [*dict.fromkeys(r["robot"] for r in rows), "all"]:
        own = [r for r in rows if name in (r["robot"], "all")]
        some, clean = ([r for r in own if r["kind"] == k] for k in ("hidden", "clean"))
        told = rate if name == "all" else lambda hits: f"{sum(hits)}/{len(hits)}"
        alarms = [r["alarm"] == "1" for r in clean]
        library, simulated, cpu = (
            np.median(column(own, key))
            for key in ("library", "simulated_trials", "cpu_seconds")
        )
        cells.append(
            (
                *(name, f"{library:.0f}"),
                told([r["verdict"] == r["effect"] for r in some]),
                told([r["right"] == "1" for r in some]),
                told([float(r["p_effect"]) > 0.1 for r in some]),
                told(alarms) if clean else "-",
                told([r["verdict"] != "none" for r in clean]) if clean else "-",
                *(f"{simulated:,.0f}", f"{cpu:.0f}"),
            )
        )
    return Table([*header, "simulated trials", "CPU s"], cells).markdown()


main = benchmark(
    RESULTS,
    run_case,
    summary,
    robot=PUBLIC,
    kind=("hidden", "clean"),
    seed=range(2000, 2010),
)
