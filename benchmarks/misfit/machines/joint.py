r"""One joint, many rows at once: leapfrog steps, dry friction, a sensor that lags.

.. math::
    I \dot v = F(q, k) - (b + c |v|)\, v - f \operatorname{sign}(v).

Forces are those of the half step :math:`q_h = q + \tfrac h2 v`, what brakes is shared
between both ends of a step, and dry friction is an impulse that can stop the joint and
hold it, never turn it around:

.. math::
    (I + \tfrac h2 d)\, v' = S_{h f}\bigl((I - \tfrac h2 d)\, v + h F\bigr), \qquad
    d = b + c |v|, \qquad S_a(z) = \operatorname{sign}(z) \max(|z| - a, 0).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.criticism.worlds.world import half_normal, normal
from benchmarks.misfit.machines.machine import (
    Form,
    Hidden,
    Machine,
    sample_times,
    sensor_effects,
)
from sbi_active.criticism import Effect

#: Forces of position and speed in units of their typical sizes, for tuning seeds.
FORMS = {
    "magnet": Form(lambda q, v: -(q / 0.3) / (1 + (q / 0.3) ** 2) ** 2),
    "two zones": Form(lambda q, v: -v * torch.sigmoid((q - 0.2) / 0.05), signed=False),
    "detent": Form(lambda q, v: torch.tanh(3 * q)),
    "swirl": Form(lambda q, v: -(q**2) * v, signed=False),
}
#: For judging seeds.
UNSEEN_FORMS = {
    "ripple": Form(lambda q, v: torch.sin(3 * q)),
    "stop": Form(lambda q, v: q.clamp(-0.6, 0.6) - q, signed=False),
    "creep": Form(
        lambda q, v: -torch.tanh(v / 0.05) * torch.exp(-v.abs() / 0.3), signed=False
    ),
    "ratchet": Form(lambda q, v: -v.clamp(min=0), signed=False),
}


def row(value: Tensor | float, like: Tensor) -> Tensor:
    """Return a number or one a row as shape (n,) or (1,), float64."""
    return torch.as_tensor(value, dtype=torch.float64).reshape(-1).expand(len(like))


def of_state(
    hidden: Hidden, scale: tuple[float, float]
) -> list[tuple[Callable[[Tensor, Tensor], Tensor], Tensor]]:
    """Return the undeclared forms with their strengths, as functions of q and v.

    Args:
        hidden: Those named "form ..." are taken.
        scale: Typical position and speed.
    """
    known = {**FORMS, **UNSEEN_FORMS}
    found = []
    for name, strength in hidden.items():
        if name.startswith("form "):
            apply = known[name.removeprefix("form ")].apply
            found.append(
                (lambda q, v, f=apply: f(q / scale[0], v / scale[1]), strength)
            )
    return found


def integrate(
    start: Tensor,
    inertia: Tensor,
    damping: Tensor,
    force: Callable[[Tensor, Tensor, int], Tensor],
    *,
    step: float,
    num_steps: int,
    coulomb: Tensor,
    quadratic: Tensor,
    wander: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return positions and speeds from rest.

    Args:
        start: Positions, shape (n,).
        inertia: Shape (n,), as all that follows.
        damping: b.
        force: ``force(q, v, k)``, all but friction, in the middle of step k.
        step: h.
        num_steps: How many.
        coulomb: f.
        quadratic: c.
        wander: Relative change of the damping by step, shape (n, steps); or None.

    Returns:
        Each of shape (n, num_steps + 1).
    """
    half = 0.5 * step
    dry = step * coulomb if bool((coulomb != 0).any()) else None
    has_drag = bool((quadratic != 0).any())
    q, v = start.clone(), torch.zeros_like(start)
    path, speed = [q], [v]
    brake = half * damping
    for k in range(num_steps):
        middle = q + half * v
        d = brake
        if wander is not None:
            d = d * (1 + wander[:, k])
        if has_drag:
            d = d + half * quadratic * v.abs()
        momentum = (inertia - d) * v + step * force(middle, v, k)
        if dry is not None:
            momentum = momentum - torch.minimum(torch.maximum(momentum, -dry), dry)
        v = momentum / (inertia + d)
        q = middle + half * v
        path.append(q)
        speed.append(v)
    return torch.stack(path, 1), torch.stack(speed, 1)


def read(
    path: Tensor, speed: Tensor, times: Tensor, *, step: float, lag: Tensor | float
) -> Tensor:
    """Return what a sensor reads at some times, late by a lag.

    Cubic Hermite interpolation; before the first step there is rest.

    Args:
        path: Values at the steps, shape (n, steps + 1).
        speed: Their derivatives in time, alike.
        times: Shape (k,) or (n, k).
        step: Of the integrator.
        lag: A number or one a row.
    """
    n, last = len(path), path.shape[1] - 2
    late = row(lag, path)[:, None]
    at = ((times.to(path).expand(n, -1) - late) / step).clamp(0, last + 1)
    low = at.floor().long().clamp(0, last)
    w = at - low
    q0, q1 = path.gather(1, low), path.gather(1, low + 1)
    v0, v1 = step * speed.gather(1, low), step * speed.gather(1, low + 1)
    rise = q1 - q0
    return q0 + w * (v0 + w * (3 * rise - 2 * v0 - v1 + w * (v0 + v1 - 2 * rise)))


class Declared(NamedTuple):
    """Strengths of the effects that all joints have, numbers or one a row.

    Attributes:
        sensor_lag: By which the sensor is late, s.
        coulomb: Dry friction.
        quadratic: Drag.
        cubic: Spring.
        trend: Force that grows in proportion to the time, at its end.
    """

    sensor_lag: Tensor | float = 0.0
    coulomb: Tensor | float = 0.0
    quadratic: Tensor | float = 0.0
    cubic: Tensor | float = 0.0
    trend: Tensor | float = 0.0


@dataclass(frozen=True)
class Joint:
    """A joint that moves for a while, and what is common to machines of one joint.

    Attributes:
        duration: Of a trial, s.
        num_steps: Of the integrator in a trial.
        scale: Typical position and speed, by which undeclared forms are scaled.
    """

    duration: float
    num_steps: int
    scale: tuple[float, float]

    @property
    def step(self) -> float:
        """Of the integrator, s."""
        return self.duration / self.num_steps

    def trajectory(
        self,
        force: Callable[[Tensor, Tensor, int], Tensor],
        start: Tensor,
        inertia: Tensor,
        damping: Tensor,
        times: Tensor,
        declared: Declared,
        hidden: Hidden,
    ) -> Tensor:
        """Return what the sensor reads after a release at rest, shape (n, k), float64.

        Args:
            force: ``force(q, v, k)`` of the bare machine without what brakes, in the
                middle of step k.
            start: Positions, shape (n,).
            inertia: Shape (n,), and so the damping.
            damping: b.
            times: s, shape (k,) or (n, k).
            declared: Effects of all joints.
            hidden: "force" and "wander damping" by step, and strengths of forms.
        """
        stiff, ramp = row(declared.cubic, start), row(declared.trend, start)
        forms, outside = of_state(hidden, self.scale), hidden.get("force")
        is_cubic, has_trend = bool((stiff != 0).any()), bool((ramp != 0).any())

        def total(q: Tensor, v: Tensor, k: int) -> Tensor:
            value = force(q, v, k)
            if is_cubic:
                value = value - stiff * q**3
            if has_trend:
                value = value + ramp * ((k + 0.5) / self.num_steps)
            if outside is not None:
                value = value + outside[:, k]
            for apply, strength in forms:
                value = value + strength * apply(q, v)
            return value

        path, speed = integrate(
            start,
            inertia,
            damping,
            total,
            step=self.step,
            num_steps=self.num_steps,
            coulomb=row(declared.coulomb, start),
            quadratic=row(declared.quadratic, start),
            wander=hidden.get("wander damping"),
        )
        return read(path, speed, times, step=self.step, lag=declared.sensor_lag)

    def machine(
        self,
        fn: Callable[..., Tensor],
        num_samples: int,
        *,
        gain: str,
        lag: float,
        strengths: Sequence[float],
        units: Sequence[str],
        loose: str,
        **options: Any,
    ) -> Machine:
        """Return a machine of one joint, with the library that all of them have.

        Args:
            fn: Its simulator, which takes ``times``.
            num_samples: A trial.
            gain: Name of the effect on the motor.
            lag: Prior deviation of the sensor's, s.
            strengths: Those of dry friction, drag, spring and trend.
            units: Of these four.
            loose: What may wander besides the damping.
            options: Further ones of :class:`Machine`.
        """
        times = sample_times(self.duration, num_samples)
        names = ("Coulomb", "quadratic drag", "cubic spring", "trend")
        keywords = Declared._fields[1:]
        makers = (half_normal, half_normal, half_normal, normal)
        forms = {**FORMS, **UNSEEN_FORMS}
        return Machine(
            fn=partial(fn, times=times),
            times=times,
            library=[
                Effect.keyword(
                    "sensor lag",
                    prior=half_normal(lag),
                    units="s",
                    family="observation",
                ),
                *sensor_effects(bias=0.05, gain=0.1, drift=0.01),
                Effect.keyword(gain, prior=normal(0.1), family="action"),
                *[
                    Effect.keyword(name, keyword, prior=make(sd), units=unit)
                    for name, keyword, make, sd, unit in zip(
                        names, keywords, makers, strengths, units, strict=True
                    )
                ],
            ],
            fast=("sensor lag", "Coulomb"),
            slow=("bias", "drift", "trend"),
            forms=[*FORMS],
            unseen_forms=[*UNSEEN_FORMS],
            unsigned_forms=[name for name, form in forms.items() if not form.signed],
            wandering=("wander damping", f"wander {loose}"),
            num_steps=self.num_steps,
            **options,
        )
