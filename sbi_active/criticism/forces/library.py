"""Effects that are generalized forces of the dictionary, on every joint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect, UnderKey
from sbi_active.criticism.effects.table import picked
from sbi_active.criticism.forces.dictionary import (
    FORMS,
    FREE,
    NUM_SHAPES,
    FormForce,
    Joint,
)
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.expected import require
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel

#: How families of forces begin: their forms are alternatives of one cause.
FAMILY = "force in "
#: Constant force, N or N m, whose effect early in a trial tells of inertia.
PUSH = 1e-3
#: Prefix of forces that depend on another joint.
COUPLING = "coupling with "


def force_effects(
    simulator: Any,
    prior: Distribution | None = None,
    trials: Trials | None = None,
    *,
    joints: Sequence[str] | None = None,
    slides: Sequence[str] = (),
    include: str | Sequence[str] = "*",
    exclude: str | Sequence[str] = (),
    seed: int = 0,
) -> list[Effect]:
    r"""Return generalized forces that a simulator may lack, on each of its joints.

    .. math::
        \tau_j \mathrel{+}= \phi\, b(q, v, t, \text{trial})

    with b of a dictionary, each scaled to a root mean square of a fifth of the force
    that nominal motion takes, so that phi is about one. Every form is in the family of
    what it depends on ("force in q of hinge"): trials tell the family first, and the
    form within it only where they reach far enough. Free shapes f(q), f(v), f(t) and
    f(q) v are smooth forms that are in no dictionary (``exclude="free*"``).

    The simulator takes ``force=`` and adds ``total_force(force, q, v, t)`` in each
    step. MuJoCo models of ``sbi_active.mujoco`` do.

    Args:
        simulator: Simulator as above; a robot of ``sbi_active.mujoco`` brings prior and
            trials.
        prior: Prior of its parameters, at draws of which nominal trajectories are
            simulated.
        trials: Trials to be explained, whose actions are taken.
        joints: Names, one a degree of freedom, in the order of v; None takes those of a
            MuJoCo model, or "joint 1", "joint 2", ...
        slides: Joints that slide, whose forms are in units of their range: a sine of q
            in metres means nothing.
        include: Patterns of names of effects, as in "*of hinge" or "sin*".
        exclude: Patterns of names of effects that are taken out.
        seed: Seed of the draws.

    Raises:
        ValueError: If prior or trials are missing, the simulator never asks for
            forces, the names are not one a degree of freedom, or a pattern matches
            nothing.

    Example:
        >>> from sbi_active import GaussianNoise
        >>> from sbi_active.criticism.forces import total_force
        >>> def fall(theta, action, *, force=None):
        ...     q, v, out = action.clone(), torch.zeros_like(action), []
        ...     for k in range(20):
        ...         tau = total_force(force, q, v, 0.05 * k)
        ...         v = v + 0.05 * (tau - 9.81 * q / theta)
        ...         q = q + 0.05 * v
        ...         out.append(q[:, 0])
        ...     return torch.stack(out, 1)
        >>> model = SimulatorModel(fall, noise=GaussianNoise(0.01), batched=True)
        >>> lengths = Independent(Normal(torch.ones(1), 0.1 * torch.ones(1)), 1)
        >>> swings = torch.linspace(0.2, 1.0, 4)[:, None]
        >>> trials = Trials(swings, fall(torch.ones(4, 1), swings))
        >>> found = force_effects(model, lengths, trials, joints=["hinge"])
        >>> len(found), found[6].name, found[6].family
        (33, 'sin 2q of hinge', 'force in q of hinge')
    """
    if not isinstance(simulator, SimulatorModel):
        prior = simulator.prior if prior is None else prior
        trials = simulator.trials if trials is None else trials
        simulator = simulator.simulator
    if prior is None or trials is None:
        raise ValueError(
            "expected a prior and trials; got None; pass those that the closed loop "
            "gets, or a robot with recordings"
        )
    nominal = trajectories(simulator, prior, trials, seed=seed)
    known = _joints(simulator, nominal, joints, slides)
    low, high = float(trials.index.min()), float(trials.index.max())
    order = 0.5 * (low + high), max(0.5 * (high - low), 0.5)
    found: list[Effect] = []
    for joint in known:
        scale = 0.2 * nominal.force[joint.dof]  # a prior deviation
        for name, family, force in _forces(joint, known, nominal):
            sized = _sized(force, nominal, scale)
            if sized is not None:
                found.append(_effect(name, family, sized, order))
    return picked(found, include, exclude)


def is_force(effect: Effect) -> bool:
    """Return whether an effect is a force of the dictionary."""
    return str(effect.family).startswith((FAMILY, COUPLING))


def _forces(
    joint: Joint, joints: Sequence[Joint], nominal: Trajectories
) -> Iterator[tuple[str, str, FormForce]]:
    """Yield name, family and force of all forms on a joint."""
    force = FormForce(joint, "", 1.0, float(np.ptp(nominal.time)))
    for form, (what, _) in FORMS.items():
        family = f"{FAMILY}{what} of {joint.name}"
        yield f"{form} of {joint.name}", family, replace(force, form=form)
    for other, form in product((j for j in joints if j is not joint), ("q", "v")):
        name = f"{form} of {other.name} on {joint.name}"
        coupled = replace(force, form=form, other=other)
        yield name, f"{COUPLING}{joint.name}", coupled
    for what in FREE:
        form, depends = f"free f({what})", what.replace(" times ", " and ")
        family = f"{FAMILY}{depends} of {joint.name}"
        yield f"{form} of {joint.name}", family, replace(force, form=form)


def _sized(force: FormForce, nominal: Trajectories, scale: float) -> FormForce | None:
    """Return the force of size one at phi = 1; None if it does nothing."""
    begin = float(nominal.time[0])
    squares = []
    for k, t in enumerate(nominal.time):
        q, v = nominal.q[:, k], nominal.v[:, k]
        values = force.values(q, v, float(t) - begin, np.ones(len(q)))
        squares.append((values**2).sum(1).mean())
    size = float(np.sqrt(np.mean(squares)))
    return None if size < 1e-6 else replace(force, size=scale / size)


def _effect(
    name: str, family: str, force: FormForce, order: tuple[float, float]
) -> Effect:
    dim = NUM_SHAPES if force.form.startswith("free") else 1
    return Effect(
        name,
        hook="dynamics",
        prior=Independent(Normal(torch.zeros(dim), torch.ones(dim)), 1),
        null=0.0,
        apply=UnderKey("force", force, order),
        units=f"times {force.size:.3g} {force.joint.unit}",
        family=family,
        describe=f"a generalized force, {name}",
        needs_order=force.form.startswith("trial"),
    )


def _joints(
    simulator: SimulatorModel,
    nominal: Trajectories,
    names: Sequence[str] | None,
    slides: Sequence[str],
) -> list[Joint]:
    num, got = nominal.v.shape[2], f"{nominal.q.shape[2]} and {nominal.v.shape[2]}"
    advice = "leave free and ball joints out of what forces see"
    same = nominal.q.shape[2] == num
    require(same, "a position for each velocity", got, advice)
    if names is None:
        own: Any = getattr(simulator.fn, "joints", None)
        names, slides = own or ([f"joint {k + 1}" for k in range(num)], slides)
    assert names is not None
    advice = "name each degree of freedom in the order of v"
    same, got = len(names) == num, ", ".join(names)
    require(same, f"{num} names of joints", got, advice)
    found = []
    for k, name in enumerate(names):
        q, v = nominal.q[..., k], nominal.v[..., k]
        away = np.percentile(np.abs(q), 90) / 1.5 if name in slides else 1.0
        position = float(max(away, 1e-12))
        velocity = float(max(np.sqrt(np.mean(v**2)), 1e-12))
        low, high = zip(_ends(q / position), _ends(v / velocity), strict=True)
        unit = "N" if name in slides else "N m"
        found.append(Joint(name, k, unit, position, velocity, low, high))
    return found


def _ends(values: Any) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * max(high - low, 1e-6)  # by which free shapes reach beyond
    return low - margin, high + margin


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
            force[:, self.dof] = PUSH * phi[:, 0]
        return force


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
    some = torch.linspace(0, len(trials) - 1, min(6, len(trials))).long()
    picked = trials.select(some.unique().tolist())
    generator = torch.Generator().manual_seed(seed)
    with forked_generators(int(torch.randint(2**31, (), generator=generator))):
        theta = prior.sample(torch.Size([4])).double()
    time, q, v = _recorded(model, picked, theta, None)
    kept = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    q, v = q[kept], v[kept]
    early = max(int(np.searchsorted(time, 0.01 * time[-1])), 1)
    acceleration = np.gradient(v, time, axis=1)
    force = np.empty(v.shape[2])
    for dof in range(v.shape[2]):
        pushed = _recorded(model, picked, theta, dof)[2][kept]
        gained = (pushed - v)[:, early, dof] / (time[early] - time[0])
        inertia = PUSH / np.maximum(np.abs(np.median(gained)), 1e-12)
        force[dof] = inertia * np.sqrt(np.mean(acceleration[..., dof] ** 2))
    return Trajectories(time, q, v, force)


def _recorded(
    model: SimulatorModel, trials: Trials, theta: Tensor, dof: int | None
) -> tuple[Array, Array, Array]:
    recorder, prior = _Recorder(dof), Normal(torch.zeros(1), torch.ones(1))
    applied = {"null": 0.0, "apply": UnderKey("force", recorder)}
    effect = Effect("recorder", hook="dynamics", prior=prior, **applied)
    simulator = TrialSimulator(AugmentedSimulator(model, [effect]), trials)
    simulator.predict(theta, {"recorder": torch.ones(len(theta), 1)})
    expected, got = "a simulator that adds generalized forces", "one that never asks"
    advice = "call total_force(force, q, v, t) in each of its steps"
    require(bool(recorder.seen), expected, got, advice)
    times = sorted(recorder.seen)
    q, v = zip(*[recorder.seen[t] for t in times], strict=True)
    return np.array(times), np.stack(q, 1), np.stack(v, 1)
