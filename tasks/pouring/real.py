r"""Real-to-sim pouring of Kim & Matsubara (2025), section 5.5, without a robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.criticism import Effect
from sbi_active.simulation import SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.pouring.effects import make_effects
from sbi_active.tasks.pouring.materials import Particles, cubes, load_pybullet
from sbi_active.tasks.pouring.model import REAL_PARAMETER_NAMES, Pours, images_of
from sbi_active.tasks.pouring.summaries import ImagePCA, mesh_coverage
from sbi_active.tasks.pouring.task import PLACES, Summary, grid

__all__ = ["PouringRealTask", "intersection_volume"]

HEIGHTS, RATES = (15, 35, 55), (0.2, 0.9, 1.6)
#: Where the paper compares images: height, cm, place, cm, and rate, rad/s.
COMPARED_AT = (35.0, 0.0, 0.9)
SIZES_SEED = 22  # of the particles' sizes: a heap of material is always the same one
BEAD = (0.002, 0.002, 0.0025)  # m: radius twice, half the height
LARGEST = 0.003  # m, of half a bead's height
SIDES = (0.002, 0.006)  # m, of gravel
#: In the order of ``REAL_PARAMETER_NAMES``: what a material is made of. Half of the
#: beads or more stay in view, so that two pours of them share more than a pour of them
#: and one of the prior's cubes do: without that InterVol tells nothing.
MADE_OF = {
    "beads": (0.6, 0.45, 0.3, 0.6, 0.9, 0.3, 0.05, 0.5),
    "gravel": (0.6, 0.45, 0.3, 0.8, 0.7, 0.2, 0.05, 0.1),
}
DENSITIES = {"beads": 400.0, "gravel": 1430.0}  # kg/m^3, the paper's
#: What the model has no parameter for, besides the shape and the spread of sizes.
UNDECLARED = {"beads": {"tilt": 1.0}, "gravel": {"cohesion": 0.4, "tilt": 1.0}}


class PouringRealTask(Task):
    r"""Calibrate cubes to a material that no parameter reproduces.

    The material is simulated as well: nobody poured it, and no robot was here.
    "beads" are cylinders of 4 mm and 5 mm with sizes that spread by 8 %, on a ground
    that tilts by 1 degree; "gravel" are boxes with sides of 2 to 6 mm, whose friction
    differs from stone to stone by 30 %, with cohesion and a tilt of 1 degree; all of
    them ``size`` times as large, since 100 small ones hardly overlap in two images of
    30 x 30 cm, as the paper's 1,000 do. The model is made of cubes of one size with
    eight parameters: friction, dynamic friction and restitution of the ground,
    friction, rolling friction and restitution of a cube, and linear and angular
    damping, each in [0, 1]. Its density is the material's, which matters for nothing
    where all particles have it.

    There is no true theta: ``theta_true`` is NaN, and beliefs are judged by
    :func:`intersection_volume`.

    Args:
        material: "beads" or "gravel".
        cubes: Number poured, of the model and the material alike.
        size: Of each, in that of the paper's.

    Attributes:
        num_rounds: Trials in the paper.
        pours: Of the model.
        real_pours: Of the material.

    Raises:
        ImportError: If PyBullet is not installed.
        ValueError: If the material is unknown or there are too many cubes.

    References:
        Kim & Matsubara, Applied Intelligence 2025, section 5.5, Fig. 16.
    """

    name = "pouring_real"
    num_rounds = 4

    def __init__(
        self, *, material: str = "beads", cubes: int = 100, size: float = 2.0
    ) -> None:
        load_pybullet()
        if material not in MADE_OF:
            raise ValueError(
                f"expected material among 'beads', 'gravel'; got {material!r}; choose "
                "one of these"
            )
        if not 0 < size < math.inf:
            raise ValueError(f"expected size > 0; got {size}; pour the paper's at 1")
        self.material, self.cubes, self.size = material, cubes, size
        model = _cubes(cubes, density=DENSITIES[material], size=size)
        self.pours = Pours(model, REAL_PARAMETER_NAMES)
        real = real_particles(material, cubes, size)
        self.real_pours = Pours(real, REAL_PARAMETER_NAMES)
        dim = len(REAL_PARAMETER_NAMES)
        self.theta_true = torch.full((dim,), math.nan)
        self.prior = BoxUniform(torch.zeros(dim), torch.ones(dim))
        self.actions = grid(HEIGHTS, PLACES, RATES)
        self.simulator = SimulatorModel(
            self.pours.images, parameter_names=self.pours.parameter_names
        )

    def real_system(self, action: Tensor, *, seed: int | None = None) -> Tensor:
        """Pour the material, see :meth:`.Task.real_system`; an image (22500,)."""
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        poses = self.real_pours.poses(
            torch.tensor([MADE_OF[self.material]]),
            action.reshape(1, -1),
            torch.tensor([seed]),
            **UNDECLARED[self.material],
        )
        return images_of(poses, self.real_pours.particles)[0]

    def summaries(
        self, images: Tensor, *, num_components: int = 36
    ) -> dict[str, Summary]:
        """Return the summaries by name, as :meth:`.PouringTask.summaries`."""
        pca = ImagePCA(images, num_components)
        return {"pca": pca, "mesh coverage": mesh_coverage}

    def effects(self) -> list[Effect]:
        """Return what a real pour may have and the model lacks; dampings it has."""
        return [effect for effect in make_effects() if "damping" not in effect.name]

    def with_truth(self, theta_true: Sequence[float] | Tensor) -> Task:
        """Refuse: the material is no point of the model.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            f"expected a material; got a truth, theta = {theta_true}; call "
            "get_task('pouring_real', material=...), or pour cubes from the simulator"
        )

    def _options(self) -> dict[str, Any]:
        return {"material": self.material, "cubes": self.cubes, "size": self.size}


def intersection_volume(real: Tensor, simulated: Tensor) -> Tensor:
    r"""Return :math:`\sum_a \min(X_1(a), X_2(a))` over pixels a, in mm, shape (n,).

    The paper's InterVol is its mean over draws from the belief.

    Args:
        real: An image of the material, shape (22500,).
        simulated: Shape (n, 22500).
    """
    return torch.minimum(real, simulated).sum(-1)


def real_particles(material: str, num: int, size: float) -> Particles:
    """Return the simulated material: "beads" or "gravel"."""
    rng = np.random.default_rng(SIZES_SEED)
    if material == "beads":
        own = np.exp(0.08 * rng.standard_normal((num, 1)))
        half = size * np.minimum(np.array(BEAD) * own, LARGEST)
        return Particles(half, "cylinder", DENSITIES[material], spread=0.1)
    half = size * rng.uniform(*SIDES, (num, 3)) / 2
    return Particles(half, "box", DENSITIES[material], spread=0.3)


_cubes = cubes  # the option has the same name
