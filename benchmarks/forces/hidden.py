"""Forces that are hidden, of a size at which they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.forces.machines import Machine
from sbi_active.criticism import Effect
from sbi_active.criticism.forces.dictionary import Joint

Array = NDArray[Any]

#: Trials in order of execution, and those of them that are held out.
NUM_TRIALS, HELD_OUT = 16, (1, 4, 6, 9, 11, 14)
FITTED = tuple(k for k in range(NUM_TRIALS) if k not in HELD_OUT)
#: Chi-square over its degrees of freedom that the refitted bare model is left with.
EXCESS = 40.0, 2_000.0
#: Largest strength, in deviations of the prior, and tries at the wanted excess.
LARGEST, TRIES = 4.0, 7
#: Delays of the drive that are tried at most, s.
LONGEST = 0.3

#: Forms that no dictionary has, of q and v in units of the joint.
OUTSIDE: dict[str, Callable[[Array, Array], Array]] = {
    "magnet": lambda q, v: -(q / 0.3) / (1 + (q / 0.3) ** 2) ** 2,
    "bump": lambda q, v: np.exp(-0.5 * ((q - 0.4) / 0.2) ** 2),
    "friction in two zones": lambda q, v: -v / (1 + np.exp(-(q - 0.2) / 0.05)),
    "spring that saturates": lambda q, v: np.tanh(3 * q),
}
DELAY = "delay of the drive"


@dataclass(frozen=True)
class OutsideForce:
    """A force of no dictionary on one joint."""

    form: str
    joint: Joint
    size: float

    def __call__(self, q: Array, v: Array, t: float, phi: Array) -> Array:
        """Return the force, shape (n, joints)."""
        joint, force = self.joint, np.zeros_like(v)
        at, speed = q[:, joint.dof] / joint.position, v[:, joint.dof] / joint.velocity
        force[:, joint.dof] = self.size * phi[:, 0] * OUTSIDE[self.form](at, speed)
        return force


@dataclass(frozen=True)
class Hidden:
    """What the truth has and the simulator lacks.

    Attributes:
        name: Of the effect, or of a form that is none.
        size: In deviations of the prior; a delay in s.
        force: As simulators take it; None for a delay, or nothing.
        excess: Chi-square over its degrees of freedom, of the refitted bare model.
    """

    name: str = ""
    size: float = 0.0
    force: Any = None
    excess: float = 0.0

    def respond(self, machine: Machine, theta: Tensor, action: Tensor) -> Tensor:
        """Return outcomes of the trials in their order, without noise."""
        place = torch.linspace(-1, 1, len(action), dtype=torch.float64)
        options: dict[str, Any] = {}
        if self.force is not None:
            size = torch.full_like(place, self.size)
            options["force"] = {self.force: torch.stack([size, place], 1)}
        elif self.name == DELAY:
            options["delay"] = self.size
        num, model = machine.num_simulated, machine.model
        if model.sample_times is not None and "times" in model.conditions:
            options["times"] = model.sample_times.expand(len(action), -1)
        x = model.fn(theta.expand(len(action), -1), action, **options)
        machine.num_simulated = num  # the truth's are not the verdict's
        return x


def draw(
    kind: str,
    machine: Machine,
    effects: Sequence[Effect],
    theta: Tensor,
    action: Tensor,
    generator: torch.Generator,
) -> Hidden:
    """Return a hidden force of a drawn form and excess; what is absorbed is redrawn.

    Args:
        kind: "single" of the dictionary, "outside" of it, "magnet" (sin 2q), "clean".
        machine: In which it is hidden.
        effects: The dictionary.
        theta: Of the truth, shape (1, d).
        action: Of all trials.
        generator: Source of the draws.
    """
    if kind == "clean":
        return Hidden()
    forms = {e.name: e.apply.key for e in effects if not e.name.startswith("free")}
    if kind == "magnet":
        forms = {n: f for n, f in forms.items() if n.startswith("sin 2q")}
    if kind == "outside":
        forms = _outside(machine, [*forms.values()])
    names = [*forms]
    while True:
        name = names[int(torch.randint(len(names), (1,), generator=generator))]
        u, sign = torch.rand(2, generator=generator).tolist()
        wanted = float(np.exp(np.log(EXCESS[0]) + u * np.log(EXCESS[1] / EXCESS[0])))
        delays = name == DELAY
        begin = 0.02 if delays else 0.3
        found = Hidden(name, begin if delays or sign < 0.5 else -begin, forms[name])
        for _ in range(TRIES):  # the excess goes with the square of the size
            excess = _excess(machine, theta, action, found)
            if not np.isfinite(excess):
                break
            if 0.8 < excess / wanted < 1.25:
                return replace(found, excess=excess)
            factor = float(np.clip(np.sqrt(wanted / max(excess, 1e-9)), 0.2, 5.0))
            found = replace(found, size=found.size * factor)
            if abs(found.size) > (LONGEST if delays else LARGEST):
                break


def _outside(machine: Machine, forms: Sequence[Any]) -> dict[str, Any]:
    joints = {form.joint.name: form for form in forms}
    found: dict[str, Any] = {
        f"{form} of {name}": OutsideForce(form, own.joint, own.size)
        for form in OUTSIDE
        for name, own in joints.items()
    }
    return found | ({DELAY: None} if machine.can_delay else {})


def _excess(machine: Machine, theta: Tensor, action: Tensor, hidden: Hidden) -> float:
    """Return the chi-square of the refitted bare model on clean fitted trials."""
    some = [*FITTED]
    target = hidden.respond(machine, theta, action)[some]
    if not bool(target.isfinite().all()):
        return np.inf
    sd = torch.as_tensor(machine.sd).double()

    def residual(z: Array) -> Array:
        x = Hidden().respond(machine, torch.from_numpy(z)[None], action[some])
        return ((x - target) / sd).nan_to_num(1e3).numpy().ravel()

    low, high = np.array(machine.low), np.array(machine.high)
    start, width = theta[0].numpy(), high - low
    found = least_squares(
        residual, start, bounds=(low - 1e-9, high + 1e-9), x_scale=width
    )
    return 2 * float(found.cost)
