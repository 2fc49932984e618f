"""Motion and forces of a simulator's joints along nominal trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.forces.dictionary import SIZES
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel


@dataclass(frozen=True)
class Trajectories:
    """Nominal trajectories.

    Attributes:
        time: Times, shape (k,), s.
        q: Positions, shape (rows, k, nq).
        v: Velocities, shape (rows, k, nv).
        force: Root mean square of the force that the motion takes, (nv,), N or N m:
            of acceleration, times what a constant force shows of inertia.
    """

    time: Array
    q: Array
    v: Array
    force: Array


class _Recorder:
    """A force that writes down where the joints are, and pushes one of them or none."""

    def __init__(self, dof: int | None = None) -> None:
        self.dof, self.seen = dof, dict[float, tuple[Array, Array]]()

    def __call__(self, q: Array, v: Array, t: float, phi: Array) -> Array:
        # The last of several looks counts: the first are those at the effect's null.
        self.seen[float(t)] = q.copy(), v.copy()
        force = np.zeros_like(v)
        if self.dof is not None:
            force[:, self.dof] = SIZES.push * phi[:, 0]
        return force

    def read(self) -> tuple[Array, Array, Array]:
        times = sorted(self.seen)
        q, v = zip(*[self.seen[t] for t in times], strict=True)
        return np.array(times), np.stack(q, 1), np.stack(v, 1)


def trajectories(
    model: SimulatorModel, prior: Distribution, trials: Trials, *, seed: int = 0
) -> Trajectories:
    """Return the motion of joints in some trials, at draws of the prior.

    Args:
        model: Simulator that takes ``force=``.
        prior: Prior of its parameters.
        trials: Trials whose actions, inputs and starts are taken.
        seed: Seed of the draws.

    Raises:
        ValueError: If the simulator never asks what the force is.
    """
    some = torch.linspace(0, len(trials) - 1, min(SIZES.num_trials, len(trials))).long()
    picked = trials.select(some.unique().tolist())
    generator = torch.Generator().manual_seed(seed)
    with forked_generators(int(torch.randint(2**31, (), generator=generator))):
        theta = prior.sample(torch.Size([SIZES.num_draws])).double()
    time, q, v = _recorded(model, picked, theta, None)
    kept = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    q, v = q[kept], v[kept]
    early = max(int(np.searchsorted(time, SIZES.early * time[-1])), 1)
    acceleration = np.gradient(v, time, axis=1)
    force = np.empty(v.shape[2])
    for dof in range(v.shape[2]):
        pushed = _recorded(model, picked, theta, dof)[2][kept]
        gained = (pushed - v)[:, early, dof] / (time[early] - time[0])
        inertia = SIZES.push / np.maximum(np.abs(np.median(gained)), 1e-12)
        force[dof] = inertia * np.sqrt(np.mean(acceleration[..., dof] ** 2))
    return Trajectories(time, q, v, force)


def _recorded(
    model: SimulatorModel, trials: Trials, theta: Tensor, dof: int | None
) -> tuple[Array, Array, Array]:
    recorder = _Recorder(dof)

    def apply(value: Any, phi: Tensor, action: Tensor, context: Context) -> Any:
        return {**value, "force": {recorder: phi}}

    one = Independent(Normal(torch.zeros(1), torch.ones(1)), 1)
    effect = Effect("recorder", hook="dynamics", prior=one, null=0.0, apply=apply)
    simulator = TrialSimulator(
        AugmentedSimulator(model, [effect], next_index=int(trials.index.max()) + 1),
        trials,
    )
    simulator.predict(theta, {"recorder": torch.ones(len(theta), 1)})
    if not recorder.seen:
        raise ValueError(
            "expected a simulator that adds generalized forces; got one that never "
            "asked for them; call total_force(force, q, v, t) in each of its steps"
        )
    return recorder.read()
