"""Elements of a model by their names, and what was probably meant by others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sbi_active.expected import did_you_mean
from sbi_active.mujoco.models.spec import mujoco_of

#: Kinds of elements: what MuJoCo calls them, and the count in a model.
KINDS = {
    "body": ("mjOBJ_BODY", "nbody"),
    "joint": ("mjOBJ_JOINT", "njnt"),
    "geom": ("mjOBJ_GEOM", "ngeom"),
    "actuator": ("mjOBJ_ACTUATOR", "nu"),
    "sensor": ("mjOBJ_SENSOR", "nsensor"),
    "tendon": ("mjOBJ_TENDON", "ntendon"),
    "key": ("mjOBJ_KEY", "nkey"),
}


def names_of(model: Any, kind: str) -> list[str]:
    """Return the names of a kind of element in their order.

    An element without a name is called by its kind and number, as in "joint 0".
    """
    mujoco = mujoco_of()
    mark, count = KINDS[kind]
    is_actuator = kind == "actuator"
    number = len(model.actuator_trntype) if is_actuator else getattr(model, count)
    each = (
        mujoco.mj_id2name(model, getattr(mujoco.mjtObj, mark), i) for i in range(number)
    )
    return [name or f"{kind} {i}" for i, name in enumerate(each)]


def element_id(model: Any, kind: str, name: str) -> int:
    """Return the number of an element.

    Raises:
        ValueError: If there is none of that name, with the nearest ones.
    """
    known = names_of(model, kind)
    require_name(name, known, kind)
    return known.index(name)


def scalar_joints(model: Any) -> list[str]:
    """Return the names of hinges and slides."""
    types = mujoco_of().mjtJoint
    scalar = int(types.mjJNT_HINGE), int(types.mjJNT_SLIDE)
    each = zip(names_of(model, "joint"), model.jnt_type, strict=True)
    return [name for name, kind in each if int(kind) in scalar]


def require_name(name: str, known: Iterable[str], what: str) -> None:
    """Raise if a name is not among those that are known."""
    known = [*known]
    if name in known:
        return
    hint = did_you_mean(name, known, "correct it")
    listed = ", ".join(map(repr, known[:12])) or "none"
    more = f" and {len(known) - 12} more" if len(known) > 12 else ""
    article = "an" if what[0] in "aeiou" else "a"
    raise ValueError(
        f"expected the name of {article} {what} among {listed}{more}; got {name!r}; "
        f"{hint}"
    )


def start_places(model: Any) -> dict[str, int]:
    """Return places of start states in (qpos, qvel, act), by name.

    Joints of more than one position are numbered, as in "base[0]"; velocities are
    "hinge velocity", and states of an actuator "motor activation".
    """
    found = {}
    for name in names_of(model, "joint"):
        i = element_id(model, "joint", name)
        q, v = int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])
        kind = int(model.jnt_type[i])
        nq, nv = {0: (7, 6), 1: (4, 3)}.get(kind, (1, 1))  # free, ball
        for k in range(nq):
            found[name if nq == 1 else f"{name}[{k}]"] = q + k
        for k in range(nv):
            speed = f"{name} velocity"
            found[speed if nv == 1 else f"{speed}[{k}]"] = model.nq + v + k
    first = model.nq + model.nv
    for i, name in enumerate(names_of(model, "actuator")):
        at, number = int(model.actuator_actadr[i]), int(model.actuator_actnum[i])
        for k in range(number if at >= 0 else 0):
            state = f"{name} activation"
            found[state if number == 1 else f"{state}[{k}]"] = first + at + k
    return found


def held_places(model: Any) -> dict[str, int]:
    """Return places of what a trial holds in (ctrl, mocap_pos, mocap_quat), by name.

    Controls are "motor control"; the pose of a mocap body is "target mocap[0]" to
    "target mocap[6]", a position and a quaternion.
    """
    held = {f"{n} control": i for i, n in enumerate(names_of(model, "actuator"))}
    first, turn = model.nu, model.nu + 3 * model.nmocap
    for body, name in enumerate(names_of(model, "body")):
        k = int(model.body_mocapid[body])
        if k < 0:
            continue
        held |= {f"{name} mocap[{j}]": first + 3 * k + j for j in range(3)}
        held |= {f"{name} mocap[{3 + j}]": turn + 4 * k + j for j in range(4)}
    return held


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
    joint = name.removesuffix(" position")
    return name if name in start_places(model) else joint
