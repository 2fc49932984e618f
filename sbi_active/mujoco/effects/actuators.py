"""Effects of actuators: their law, their limits, and when they act."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.generic_series import typical_delay
from sbi_active.criticism.effects.series import delayed_input, lagged_input
from sbi_active.mujoco.effects.acting import (
    half_normal,
    model_effect,
    normal,
    uniform,
)
from sbi_active.mujoco.effects.nominal import Nominal
from sbi_active.mujoco.effects.ties import Group
from sbi_active.mujoco.effects.writing import ActuatorChange
from sbi_active.mujoco.models.names import element_id
from sbi_active.mujoco.models.quantities import Quantity, is_hinge, joint_of_actuator

__all__ = ["of_actuators"]

#: Relative error of a torque, bias and back-EMF as shares of the force, one deviation.
GAIN, BIAS, BACK_EMF = 0.1, 0.1, 0.2
#: Where an actuator saturates, in largest forces: the root mean square times this.
LIMIT = (0.3, 2.0)


def of_actuators(
    group: Group, sizes: Nominal, *, driven: Sequence[str] = ()
) -> Iterator[Effect]:
    """Yield the effects of actuators that share each phi, or of one.

    Args:
        group: Group of actuators.
        sizes: Sizes of the model.
        driven: Actuators whose inputs are signals over time.
    """
    model = sizes.model
    places = [element_id(model, "actuator", name) for name in group.names]
    force = float(sizes.actuator_force[places].mean())
    speed = float(sizes.actuator_velocity[places].mean())
    joint = joint_of_actuator(model, Quantity("actuator", group.names[0], "gear"))
    unit = "" if joint is None else "N m" if is_hinge(model, joint) else "N"
    length = "" if joint is None else "rad" if is_hinge(model, joint) else "m"

    def make(what: Any, **options: Any) -> Effect:
        return model_effect(
            f"{group.label} {what}",
            ActuatorChange(group.names, what),
            family="actuator",
            **options,
        )

    yield make(
        "gain",
        prior=normal(GAIN),
        describe=f"{group.label} gives a multiple of its force",
    )
    yield make(
        "bias",
        prior=normal(BIAS * force),
        units=unit,
        describe=f"{group.label} gives a constant force besides",
    )
    yield make(
        "back-EMF",
        prior=half_normal(BACK_EMF * force / speed),
        units=f"{unit} s/{length}" if unit else "",
        describe=f"{group.label} brakes in proportion to its speed",
    )
    yield make(
        "saturation",
        prior=uniform(LIMIT[0] * force, LIMIT[1] * force),
        null=torch.inf,
        units=unit,
        describe=f"{group.label} gives its force up to a limit",
    )
    if {*group.names} <= {*driven}:
        sd = typical_delay(torch.as_tensor(sizes.times))
        for what, series in (("delay", delayed_input), ("lag", lagged_input)):
            yield Effect(
                f"{group.label} {what}",
                hook="input",
                prior=half_normal(sd),
                null=0.0,
                apply=_Late(group.names, partial(_late, change=series)),
                units="s",
                family="actuator",
                describe=f"{group.label} acts later"
                if what == "delay"
                else f"{group.label} acts behind a first-order lag",
            )


@dataclass(frozen=True)
class _Late:
    """Changes some inputs alike."""

    names: tuple[str, ...]
    change: Any

    def __call__(
        self, value: dict[str, Tensor], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Tensor]:
        changed = {n: self.change(value[n], phi, context) for n in self.names}
        return {**value, **changed}


def _late(u: Tensor, phi: Tensor, context: Context, *, change: Any) -> Tensor:
    grid = context.input_times
    assert grid is not None
    return change(u, phi, grid[1] - grid[0])
