"""Machines in which forces are hidden: what is known of them, and what is not.

A driven pendulum, a cart with a pole, a driven spring and mass (NumPy), and an arm of
two links (MuJoCo, from its MJCF). Each has four unknown parameters or so with wide
priors, and ten trials of 20 samples a joint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism.forces import total_force

Array = NDArray[Any]
#: Acceleration from parameters, positions, speeds, the drive and generalized forces.
Law = Callable[[Array, Array, Array, Array, Array], Array]

NUM_SAMPLES, NUM_STEPS = 20, 100
GRAVITY = 9.81


@dataclass
class Machine:
    """A simulator with a prior, and how its trials are drawn.

    Attributes:
        name: Of the machine.
        model: Its simulator, with the sensor's noise.
        sd: Of the sensor, one number or one a channel.
        low: Of the parameters.
        high: Of the parameters.
        joints: Their names.
        slides: Those that slide.
        ranges: Of each entry of an action, its size.
        unsigned: Entries of an action whose sign is not drawn.
        can_delay: Whether its drive changes in time, so that a delay shows.
        num_simulated: Rows that were simulated.
    """

    name: str
    model: SimulatorModel
    sd: Any
    low: tuple[float, ...]
    high: tuple[float, ...]
    joints: tuple[str, ...]
    slides: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    unsigned: tuple[int, ...] = ()
    can_delay: bool = True
    num_simulated: int = 0
    prior: BoxUniform = field(init=False)

    def __post_init__(self) -> None:
        self.prior = BoxUniform(torch.tensor(self.low), torch.tensor(self.high))
        fn = self.model.fn

        def counted(theta: Tensor, action: Tensor, **options: Any) -> Tensor:
            self.num_simulated += len(theta)
            return fn(theta, action, **options)

        self.model.fn = counted

    def draw_actions(self, num: int, generator: torch.Generator) -> Tensor:
        """Return actions, shape (num, action_dim)."""
        low, high = torch.tensor(self.ranges, dtype=torch.float64).T
        shape = (num, len(self.ranges))
        u = torch.rand(shape, generator=generator, dtype=torch.float64)
        sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
        sign[:, list(self.unsigned)] = 1.0
        return sign * (low + (high - low) * u)

    def draw_theta(self, generator: torch.Generator) -> Tensor:
        """Return parameters away from the ends of the prior, shape (1, d)."""
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        share = 0.2 + 0.6 * torch.rand(len(low), generator=generator)
        return (low + (high - low) * share).double()[None]


class Stepped:
    r"""A simulator :math:`\ddot q = a(q, \dot q, u, \tau)` in semi-implicit steps.

    Args:
        law: a.
        start: Positions at the beginning, of the action, shape (n, joints).
        drive: The input of the action and the time, shape (n,).
        step: s.
        steps: Of a trial.
    """

    def __init__(
        self,
        law: Law,
        start: Callable[[Array], Array],
        drive: Callable[[Array, float], Array],
        *,
        step: float,
        steps: int,
    ) -> None:
        self.law, self.start, self.drive = law, start, drive
        self.step, self.steps = step, steps
        every = steps // NUM_SAMPLES
        self.times = step * every * torch.arange(1, NUM_SAMPLES + 1).double()

    def __call__(
        self, theta: Tensor, action: Tensor, *, force: Any = None, delay: float = 0.0
    ) -> Tensor:
        """Return positions, shape (n, 20), or (n, 20, joints).

        Args:
            theta: Shape (n, d).
            action: Shape (n, action_dim).
            force: Generalized forces.
            delay: Of the drive, s.
        """
        p, act = theta.double().numpy().T, action.double().numpy()
        q = self.start(act)
        v, found = np.zeros_like(q), []
        with np.errstate(all="ignore"):  # of rows that diverge
            for k in range(self.steps):
                t = k * self.step
                tau = np.zeros_like(q)
                if force:
                    some = torch.from_numpy(q), torch.from_numpy(v)
                    tau = total_force(force, *some, t).numpy()
                v = v + self.step * self.law(p, q, v, self.drive(act, t - delay), tau)
                q = q + self.step * v
                if (k + 1) % (self.steps // NUM_SAMPLES) == 0:
                    found.append(q)
        x = torch.from_numpy(np.stack(found, 1)).to(theta.dtype)
        return x[..., 0] if x.shape[-1] == 1 else x


def _swinging(p: Array, q: Array, v: Array, u: Array, tau: Array) -> Array:
    g, c, gain = p
    a = gain * u - g * np.sin(q[:, 0]) - c * v[:, 0] + tau[:, 0]
    return a[:, None]


def _carried(p: Array, q: Array, v: Array, u: Array, tau: Array) -> Array:
    mass, length, rail, hinge = p
    m = 0.3
    s, c = np.sin(q[:, 1]), np.cos(q[:, 1])
    one = u + m * length * s * v[:, 1] ** 2 - rail * v[:, 0] + tau[:, 0]
    two = -m * GRAVITY * length * s - hinge * v[:, 1] + tau[:, 1]
    a, b, d = mass + m, m * length * c, m * length**2
    det = a * d - b * b
    return np.stack([(d * one - b * two) / det, (a * two - b * one) / det], 1)


def _sprung(p: Array, q: Array, v: Array, u: Array, tau: Array) -> Array:
    mass, stiffness, damping, rest = p
    pull = stiffness * (q[:, 0] - rest) + damping * v[:, 0]
    return ((u - pull + tau[:, 0]) / mass)[:, None]


def _pushed(act: Array, t: float) -> Array:
    forth, back = 0.25 <= t < 0.75, 1.25 <= t < 1.75
    return act[:, 1] * (float(forth) - float(back))


def _stepped(
    name: str, law: Law, *, start: Any, drive: Any, step: float, sd: Any, **known: Any
) -> Machine:
    """Return a machine of a law, arguments as for :class:`Stepped` and ``Machine``."""
    function = Stepped(law, start, drive, step=step, steps=NUM_STEPS)
    noise, times = GaussianNoise(sd), function.times
    model = SimulatorModel(function, noise=noise, batched=True, sample_times=times)
    return Machine(name, model, sd, **known)


def pendulum() -> Machine:
    """Return a pendulum under a torque that oscillates."""
    return _stepped(
        "pendulum",
        _swinging,
        start=lambda act: act[:, :1].copy(),
        drive=lambda act, t: act[:, 1] * np.sin(act[:, 2] * t),
        step=0.02,
        sd=0.003,
        low=(5.0, 0.0, 0.5),
        high=(15.0, 1.0, 2.0),
        joints=("hinge",),
        slides=(),
        ranges=((0.2, 1.2), (0.5, 3.0), (1.0, 6.0)),
        unsigned=(2,),
    )


def cart_pole() -> Machine:
    """Return a cart with a hanging pole, pushed forth and back."""
    return _stepped(
        "cart-pole",
        _carried,
        start=lambda act: np.stack([np.zeros(len(act)), act[:, 0]], 1),
        drive=_pushed,
        step=0.025,
        sd=torch.tensor([0.005, 0.01]),
        low=(0.5, 0.25, 0.1, 0.005),
        high=(2.0, 1.0, 1.5, 0.06),
        joints=("rail", "hinge"),
        slides=("rail",),
        ranges=((0.2, 1.3), (2.0, 6.0)),
    )


def spring_mass() -> Machine:
    """Return a mass on a spring under a force that oscillates."""
    return _stepped(
        "spring-mass",
        _sprung,
        start=lambda act: np.zeros((len(act), 1)),
        drive=lambda act, t: act[:, 0] * np.sin(act[:, 1] * t),
        step=0.04,
        sd=0.01,
        low=(0.5, 10.0, 0.1, -0.1),
        high=(2.0, 40.0, 1.5, 0.1),
        joints=("slide",),
        slides=("slide",),
        ranges=((2.0, 8.0), (2.0, 7.0)),
        unsigned=(1,),
    )


ARM = """<mujoco><option timestep=".02" integrator="implicitfast"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping=".3"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.5"/>
<body name="fore" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".1"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/></body></body>
</worldbody><actuator><motor name="shoulder motor" joint="shoulder"/>
<motor name="elbow motor" joint="elbow"/></actuator></mujoco>"""


def arm() -> Machine:
    """Return an arm of two links with a constant torque on each joint, in MuJoCo."""
    from sbi_active import BoxActions
    from sbi_active.mujoco import from_mjcf

    low, high = (0.05, 0.02, 0.5, 0.5), (0.8, 0.4, 2.0, 3.0)
    names = ("shoulder.damping", "elbow.damping", "fore.mass", "upper.mass")
    entries = ["shoulder", "elbow", "shoulder motor", "elbow motor"]
    ends = torch.tensor([1.2, 1.2, 3.0, 1.0])
    robot = from_mjcf(
        ARM,
        dict(zip(names, zip(low, high, strict=True), strict=True)),
        sensors=["shoulder", "elbow"],
        actions=BoxActions(-ends, ends, names=entries),
        times=0.1 * np.arange(1, NUM_SAMPLES + 1),
        noise=0.005,
    )
    return Machine(
        "arm",
        robot.simulator,
        0.005,
        low=low,
        high=high,
        joints=("shoulder", "elbow"),
        slides=(),
        ranges=((0.2, 1.2), (0.2, 1.2), (0.5, 3.0), (0.2, 1.0)),
        can_delay=False,
    )


MACHINES = {
    "pendulum": pendulum,
    "cart-pole": cart_pole,
    "spring-mass": spring_mass,
    "arm": arm,
}


@cache
def machine(name: str) -> Machine:
    """Return a machine by its name, made once."""
    return MACHINES[name]()
