r"""Generalized forces: functions of position, velocity, time and trial on a joint.

In units of the joint: q of half the range it moves in on a slide (radians on a hinge),
v of the root of its mean square, t of the longest trial, the trial's number from -1 to
1. Each is in the family of what it depends on, since trials tell that with certainty
long before they tell the form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array


class Force(Protocol):
    r"""A generalized force :math:`\tau = \tau(q, v, t; \phi)`, added at every step.

    It is hashable and can be pickled; rows are independent.
    """

    def __call__(self, q: Array, v: Array, t: float, phi: Array, /) -> Array:
        """Return the force on each degree of freedom, shape (n, nv), N or N m.

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            t: Time since the start of the trial, s.
            phi: Parameters of the effect, shape (n, k).
        """
        ...


def total_force(
    force: Mapping[Force, Tensor] | None, q: Tensor, v: Tensor, t: float
) -> Tensor:
    r"""Return the sum of forces on a simulator's joints, at one time.

    A simulator ``fn(theta, action, *, force=None)`` adds it to what its joints feel:
    :math:`M(q) \dot v = \ldots + \tau`. The effects of :func:`.force_effects` then act
    on it.

    Args:
        force: Force as the simulator was given it; None is no force.
        q: Positions, shape (n, nq).
        v: Velocities, shape (n, nv).
        t: Time since the start of the trial, s.

    Returns:
        Shape (n, nv), of v's dtype.

    Example:
        >>> q, v = torch.zeros(2, 1), torch.ones(2, 1)
        >>> total_force(None, q, v, 0.0).shape
        torch.Size([2, 1])
    """
    total = np.zeros(tuple(v.shape))
    if force:
        positions, speeds = q.double().numpy(), v.double().numpy()
        with np.errstate(invalid="ignore"):  # of rows that diverge
            for one, phi in force.items():
                total += one(positions, speeds, t, phi.double().numpy())
    return torch.from_numpy(total).to(v.dtype)


Basis = Callable[[Array, Array, float, Array], Array]


#: Numbers of a free shape.
NUM_SHAPES = 7
#: Points on which a free shape is laid.
GRID = np.linspace(0.0, 1.0, 101)


def _sign(v: Array) -> Array:
    """Return dry friction, which turns over below a twentieth of the speed's unit."""
    return np.tanh(v / 0.05)


#: Family and function of each form, of (q, v, t, trial).
FORMS: dict[str, tuple[str, Basis]] = {
    "constant": ("q", lambda q, v, t, k: np.ones_like(q)),
    "q": ("q", lambda q, v, t, k: q),
    "q|q|": ("q", lambda q, v, t, k: q * np.abs(q)),
    "q^3": ("q", lambda q, v, t, k: q**3),
    "sin q": ("q", lambda q, v, t, k: np.sin(q)),
    "cos q": ("q", lambda q, v, t, k: np.cos(q)),
    "sin 2q": ("q", lambda q, v, t, k: np.sin(2 * q)),
    "cos 2q": ("q", lambda q, v, t, k: np.cos(2 * q)),
    "sin 3q": ("q", lambda q, v, t, k: np.sin(3 * q)),
    "stop beyond .5": ("q", lambda q, v, t, k: q - np.clip(q, -0.5, 0.5)),
    "stop beyond 1": ("q", lambda q, v, t, k: q - np.clip(q, -1.0, 1.0)),
    "sign v": ("v", lambda q, v, t, k: _sign(v)),
    "v": ("v", lambda q, v, t, k: v),
    "v|v|": ("v", lambda q, v, t, k: v * np.abs(v)),
    "v^3": ("v", lambda q, v, t, k: v**3),
    "Stribeck .1": ("v", lambda q, v, t, k: _sign(v) * np.exp(-np.abs(v) / 0.1)),
    "Stribeck .3": ("v", lambda q, v, t, k: _sign(v) * np.exp(-np.abs(v) / 0.3)),
    "q v": ("q and v", lambda q, v, t, k: q * v),
    "|q| v": ("q and v", lambda q, v, t, k: np.abs(q) * v),
    "q^2 v": ("q and v", lambda q, v, t, k: q**2 * v),
    "q^2 sign v": ("q and v", lambda q, v, t, k: q**2 * _sign(v)),
    "t": ("t", lambda q, v, t, k: t + 0 * q),
    "t v": ("t", lambda q, v, t, k: t * v),
    "sin 2 pi t": ("t", lambda q, v, t, k: np.sin(2 * np.pi * t) + 0 * q),
    "cos 2 pi t": ("t", lambda q, v, t, k: np.cos(2 * np.pi * t) + 0 * q),
    "sin 6 pi t": ("t", lambda q, v, t, k: np.sin(6 * np.pi * t) + 0 * q),
    "cos 6 pi t": ("t", lambda q, v, t, k: np.cos(6 * np.pi * t) + 0 * q),
    "trial": ("trial", lambda q, v, t, k: k + 0 * q),
    "trial v": ("trial", lambda q, v, t, k: k * v),
}
#: What free shapes are functions of.
FREE = ("q", "v", "t", "q times v")


@dataclass(frozen=True)
class Joint:
    """One degree of freedom, and how large things are on it.

    Attributes:
        name: Name in reports.
        dof: Place among the positions, and the velocities.
        unit: Unit of a force on it, "N" or "N m".
        position: Unit of q.
        velocity: Unit of v.
        low: Lowest q and v in their units, along nominal trajectories.
        high: Highest q and v, likewise.
    """

    name: str
    dof: int
    unit: str
    position: float
    velocity: float
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True)
class FormForce:
    """A force of a known form on one joint, phi times its size.

    Attributes:
        joint: Joint on which it acts.
        form: Name in the dictionary, or "free f(...)" of what stands in brackets.
        size: Factor that gives the form a root mean square of one.
        horizon: Unit of t, s.
        other: The joint whose q or v the form takes in place of its own.
    """

    joint: Joint
    form: str
    size: float
    horizon: float
    other: Joint | None = None

    def __call__(self, q: Array, v: Array, t: float, phi: Array) -> Array:
        """Return the force, shape (n, nv).

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            t: Time since the start of the trial, s.
            phi: Strengths, and the trial's place from -1 to 1 as the last column.
        """
        force = np.zeros_like(v)
        with np.errstate(all="ignore"):  # of rows that diverge
            values = self.values(q, v, t, phi[:, -1])
            force[:, self.joint.dof] = self.size * (phi[:, :-1] * values).sum(1)
        return force

    def values(self, q: Array, v: Array, t: float, trial: Array) -> Array:
        """Return the form's functions, shape (n, k)."""
        own = self.other or self.joint
        at = q[:, own.dof] / own.position
        speed = v[:, own.dof] / own.velocity
        time = t / self.horizon
        if not self.form.startswith("free"):
            return FORMS[self.form][1](at, speed, time, trial)[:, None]
        kind = self.form.removeprefix("free f(").removesuffix(")")
        k, place = (1, speed) if kind == "v" else (0, at)
        share = (place - own.low[k]) / (own.high[k] - own.low[k])
        if kind == "t":
            share = np.full(len(q), time)
        shapes = np.stack([np.interp(share, GRID, shape) for shape in _SHAPES], 1)
        return shapes * speed[:, None] if kind == "q times v" else shapes


def _shapes() -> Array:
    """Return the largest eigenfunctions of a smooth kernel, times their deviations."""
    apart = (GRID[:, None] - GRID) / 0.2  # the length over which it is smooth
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
    largest = np.argsort(-values)[:NUM_SHAPES]
    return (vectors[:, largest] * np.sqrt(values[largest])).T


_SHAPES = _shapes()
