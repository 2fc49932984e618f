"""Elements that are alike, such as the same joint of every leg."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_active.mujoco.models.names import names_of
from sbi_active.mujoco.models.quantities import is_scalar

__all__ = ["Group", "actuator_groups", "body_groups", "joint_groups"]

#: Relative difference of inertias, lengths and ranges that are alike.
ALIKE = 0.05


@dataclass(frozen=True)
class Group:
    """Elements that share a phi, or a single one.

    Attributes:
        names: Names of the elements.
        label: Label that effects are named by.
    """

    names: tuple[str, ...]
    label: str


def joint_groups(model: Any) -> list[Group]:
    """Return groups of symmetric joints, then each hinge and slide."""
    names = names_of(model, "joint")
    features = []
    for i in range(len(names)):
        dof, body = int(model.jnt_dofadr[i]), int(model.jnt_bodyid[i])
        features.append(
            (
                (int(model.jnt_type[i]), _depth(model, body)),
                [
                    float(model.dof_M0[dof]),
                    float(model.body_mass[body]),
                    float(np.ptp(model.jnt_range[i])),
                    *np.abs(model.jnt_axis[i]).tolist(),
                ],
            )
        )
    scalar = [i for i, name in enumerate(names) if is_scalar(model, name)]
    return _grouped([names[i] for i in scalar], [features[i] for i in scalar])


def actuator_groups(model: Any) -> list[Group]:
    """Return groups of actuators that do the same to symmetric joints, then each."""
    joints, own = joint_groups(model), names_of(model, "joint")
    names = names_of(model, "actuator")
    features = []
    for i in range(len(names)):
        joint = int(model.actuator_trnid[i, 0])
        driven = own[joint] if 0 <= joint < len(own) else ""
        place = next((k for k, g in enumerate(joints) if driven in g.names), -1)
        numbers = [
            *model.actuator_gainprm[i, :3].tolist(),
            *model.actuator_biasprm[i, :3].tolist(),
            abs(float(model.actuator_gear[i, 0])),
        ]
        features.append(((int(model.actuator_trntype[i]), place), numbers))
    return _grouped(names, features)


def body_groups(model: Any) -> list[Group]:
    """Return groups of moving bodies of one mass and depth, then each."""
    names = names_of(model, "body")
    moving = [
        i
        for i in range(1, len(names))
        if model.body_weldid[i] != 0 and model.body_mass[i] > 0
    ]
    features = [
        (
            (_depth(model, i),),
            [float(model.body_mass[i]), *model.body_inertia[i].tolist()],
        )
        for i in moving
    ]
    return _grouped([names[i] for i in moving], features)


def _grouped(names: Sequence[str], features: Sequence[Any]) -> list[Group]:
    groups: list[list[int]] = []
    for i, (kind, numbers) in enumerate(features):
        for group in groups:
            other, others = features[group[0]]
            if kind == other and np.allclose(numbers, others, rtol=ALIKE, atol=1e-9):
                group.append(i)
                break
        else:
            groups.append([i])
    tied = [[names[i] for i in group] for group in groups if len(group) > 1]
    return [
        *[Group(tuple(each), _common(each)) for each in tied],
        *[Group((name,), name) for name in names],
    ]


def _common(names: Sequence[str]) -> str:
    """Return a name for several elements, as in "all calf_joint"."""
    end = os.path.commonprefix([name[::-1] for name in names])[::-1]
    begin = os.path.commonprefix([*names])
    shared = max(end, begin, key=len).strip("_- ./")
    whole = re.search(r"[A-Za-z]", shared)
    return f"all {shared}" if whole else f"all of {', '.join(names)}"


def _depth(model: Any, body: int) -> int:
    depth = 0
    while body:
        body = int(model.body_parentid[body])
        depth += 1
    return depth
