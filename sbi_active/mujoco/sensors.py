"""Sensors of the MJCF, and those of joints that it does not have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sbi_active.mujoco.models.names import names_of, require_name, scalar_joints
from sbi_active.mujoco.models.quantities import units_of
from sbi_active.mujoco.models.spec import Source, mujoco
from sbi_active.mujoco.simulator import Channel

VELOCITY = " velocity"
#: MuJoCo's sensor of each quantity, and what it is attached to.
READ = {
    "position": ("JOINTPOS", "JOINT"),
    "velocity": ("JOINTVEL", "JOINT"),
    "force": ("ACTUATORFRC", "ACTUATOR"),
}
#: Units of MuJoCo's sensors; L in braces is that of the joint.
UNITS = {
    "JOINTPOS": "{L}",
    "JOINTVEL": "{L}/s",
    "ACCELEROMETER": "m/s^2",
    "GYRO": "rad/s",
    "FRAMEPOS": "m",
    "FORCE": "N",
    "TORQUE": "N m",
    "TOUCH": "N",
    "VELOCIMETER": "m/s",
}


@dataclass(frozen=True)
class AddedSensor:
    """Adds a sensor of a joint's position or velocity, or of an actuator's force.

    Attributes:
        name: Name of the sensor.
        owner: Name of the joint or the actuator.
        what: Quantity that it reads.
    """

    name: str
    owner: str
    what: str

    def __call__(self, spec: Any) -> None:
        """Add it to a spec."""
        kind, owner = READ[self.what]
        spec.add_sensor(
            name=self.name,
            type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
            objtype=getattr(mujoco.mjtObj, f"mjOBJ_{owner}"),
            objname=self.owner,
        )


def added_sensors(source: Source, sensors: Sequence[str] | None) -> Source:
    """Return a source with sensors of those joints that are named in their place.

    Args:
        source: Source of the model.
        sensors: Names; None for those that the model has, or else all its joints.

    Raises:
        ValueError: If there is neither a sensor nor a joint of a name.
    """
    model = source.compile()
    own, joints = names_of(model, "sensor"), scalar_joints(model)
    sensors = own or [*joints] if sensors is None else sensors
    known = [*own, *joints, *[j + VELOCITY for j in joints]]
    edits = []
    for name in sensors:
        require_name(name, known, "sensor or joint")
        if name not in own:
            what = "velocity" if name.endswith(VELOCITY) else "position"
            edits.append(AddedSensor(name, name.removesuffix(VELOCITY), what))
    return source.edited(*edits)


def channels_of(model: Any, sensors: Sequence[str] | None) -> tuple[Channel, ...]:
    """Return the numbers that sensors read, in the order of their names.

    Args:
        model: Compiled model, with all of them.
        sensors: Names; None for all.
    """
    own = names_of(model, "sensor")
    channels = []
    for name in own if sensors is None else sensors:
        i = own.index(name)
        place, width = int(model.sensor_adr[i]), int(model.sensor_dim[i])
        for k in range(width):
            called = name if width == 1 else f"{name}[{k}]"
            channels.append(Channel(called, place + k, _unit(model, i)))
    return tuple(channels)


def _unit(model: Any, i: int) -> str:
    kind = mujoco.mjtSensor(int(model.sensor_type[i])).name
    unit = UNITS.get(kind.removeprefix("mjSENS_"), "")
    if "{" not in unit:
        return unit
    joint = names_of(model, "joint")[int(model.sensor_objid[i])]
    return unit.format(**units_of(model, joint))
