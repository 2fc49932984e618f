"""Elements of a model by their names, and what was probably meant by others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from sbi_active.expected import did_you_mean
from sbi_active.mujoco.models.spec import mujoco

#: Kinds of elements, each with a field of ``mjModel`` that has a row an element.
KINDS = {
    "body": "body_mass",
    "joint": "jnt_type",
    "geom": "geom_type",
    "actuator": "actuator_trntype",
    "sensor": "sensor_type",
    "tendon": "tendon_stiffness",
    "key": "key_time",
}


def names_of(model: Any, kind: str) -> list[str]:
    """Return the names of a kind of element in their order.

    An element without a name is called by its kind and number, as in "joint 0".
    """
    mark = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    number = len(getattr(model, KINDS[kind]))
    each = (mujoco.mj_id2name(model, mark, i) for i in range(number))
    return [name or f"{kind} {i}" for i, name in enumerate(each)]


def element_id(model: Any, kind: str, name: str) -> int:
    """Return the number of an element.

    Raises:
        ValueError: If there is none of that name, with the nearest ones.
    """
    known = names_of(model, kind)
    require_name(name, known, kind)
    return known.index(name)


def scalar_joints(model: Any) -> dict[str, int]:
    """Return the numbers of hinges and slides by name."""
    types = mujoco.mjtJoint
    is_scalar = np.isin(model.jnt_type, [types.mjJNT_HINGE, types.mjJNT_SLIDE])
    names = names_of(model, "joint")
    return {names[i]: int(i) for i in np.flatnonzero(is_scalar)}


def require_name(name: str, known: Iterable[str], what: str) -> None:
    """Raise if a name is not among those that are known."""
    known = [*known]
    if name in known:
        return
    hint = did_you_mean(name, known, "correct it")
    some = ", ".join(map(repr, known[:12])) or "none"
    raise ValueError(
        f"expected the name of one {what}, as are {some}; got {name!r}; {hint}"
    )


def start_places(model: Any) -> dict[str, int]:
    """Return places of start states in MuJoCo's full physics state, by name.

    Joints of more than one position are numbered, as in "base[0]"; velocities are
    "hinge velocity", and states of an actuator "motor activation".
    """
    found: dict[str, int] = {}
    positions, velocities = 1, 1 + model.nq  # the time comes first
    activations = velocities + model.nv
    for i, name in enumerate(names_of(model, "joint")):
        kind = int(model.jnt_type[i])
        nq, nv = {0: (7, 6), 1: (4, 3)}.get(kind, (1, 1))  # free, ball
        found |= _numbered(name, positions + int(model.jnt_qposadr[i]), nq)
        speed = velocities + int(model.jnt_dofadr[i])
        found |= _numbered(f"{name} velocity", speed, nv)
    for i, name in enumerate(names_of(model, "actuator")):
        first = int(model.actuator_actadr[i])
        number = int(model.actuator_actnum[i]) if first >= 0 else 0
        found |= _numbered(f"{name} activation", activations + first, number)
    return found


def places_of(model: Any) -> dict[str, int]:
    """Return places of all that a trial may set, by name.

    The physics state of :func:`start_places` is followed by what is held: controls,
    "motor control", and the poses of mocap bodies, "target mocap[0]" to
    "target mocap[6]", a position and a quaternion.
    """
    found, first = start_places(model), physics_size(model)
    for i, name in enumerate(names_of(model, "actuator")):
        found[f"{name} control"] = first + i
    position = first + model.nu
    turn = position + 3 * model.nmocap
    for body, name in enumerate(names_of(model, "body")):
        k = int(model.body_mocapid[body])
        if k >= 0:
            found |= {f"{name} mocap[{j}]": position + 3 * k + j for j in range(3)}
            found |= {f"{name} mocap[{3 + j}]": turn + 4 * k + j for j in range(4)}
    return found


def physics_size(model: Any) -> int:
    """Return the number of entries of MuJoCo's full physics state."""
    return mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)


def _numbered(name: str, first: int, number: int) -> dict[str, int]:
    """Return the places of a name, with numbers in brackets where it has several."""
    if number == 1:
        return {name: first}
    return {f"{name}[{k}]": first + k for k in range(number)}


def meaning(name: str, model: Any) -> str:
    """Return the quantity that an entry of an action sets, by its name.

    A name that a joint and an actuator share is the actuator's, as in "hinge control";
    the joint's start is then "hinge position".

    Args:
        name: Name of the entry.
        model: Compiled model.
    """
    if name in names_of(model, "actuator"):
        return f"{name} control"
    return name if name in start_places(model) else name.removesuffix(" position")
