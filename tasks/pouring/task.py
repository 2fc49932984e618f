"""The pouring task of Kim & Matsubara (2025), section 5.4."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.criticism import Effect
from sbi_active.simulation import SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.pouring.effects import make_effects
from sbi_active.tasks.pouring.materials import cubes, load_pybullet
from sbi_active.tasks.pouring.model import ACTION_NAMES, ACTION_UNITS, Pours
from sbi_active.tasks.pouring.summaries import ImagePCA, mesh_coverage

__all__ = ["PouringTask", "Summary", "grid"]

Summary = Callable[[Tensor], Tensor]  # of raw images, (n, 22500) -> (n, d)

HEIGHTS, PLACES, RATES = (20, 80, 140), (-30, 0, 30), (0.5, 2.0, 5.0)
TARGETS = {1: (0.2, 0.2, 0.8), 2: (0.8, 0.8, 0.2)}


class PouringTask(Task):
    r"""Pour cubes from a bucket and find their friction, rolling and restitution.

    The action is the height h of the bucket (cm), its place p along y (cm) and the rate
    v at which it turns (rad/s); x is the depth image of 30 x 30 cm about the origin at
    rest, 150 x 150 heights in mm, as one row. The simulator is itself the draw: the
    cubes fall chaotically, and no other noise is declared.

    A posterior is learned from a summary of the image, and which summary is part of
    what is chosen: :meth:`summaries` names them, functions of one raw outcome.

    Args:
        cubes: Number poured, 1 to 1000.
        target: The real system: 1 slips and bounces, (.2, .2, .8); 2 sticks,
            (.8, .8, .2).
        theta_true: Another real system, within [0, 1]; None takes the target's.

    Attributes:
        num_rounds: Trials in the paper.
        pours: Gives poses, which are small and from which images are made on demand.

    Raises:
        ImportError: If PyBullet is not installed.
        ValueError: If the target is unknown, ``theta_true`` leaves the box or there are
            too many cubes.

    References:
        Kim & Matsubara, Applied Intelligence 2025, section 5.4, Figs. 11 and 12.
    """

    name = "pouring"
    num_rounds = 6

    def __init__(
        self,
        *,
        cubes: int = 100,
        target: int = 1,
        theta_true: Sequence[float] | Tensor | None = None,
    ) -> None:
        load_pybullet()
        if target not in TARGETS:
            raise ValueError(
                f"expected target among 1, 2; got {target!r}; choose one of these"
            )
        truth = TARGETS[target] if theta_true is None else theta_true
        self.theta_true = torch.as_tensor(truth, dtype=torch.float32)
        inside = (self.theta_true >= 0) & (self.theta_true <= 1)
        if self.theta_true.shape != (3,) or not bool(inside.all()):
            raise ValueError(
                f"expected theta_true of three numbers within [0, 1]; got {theta_true};"
                " choose another truth"
            )
        self.cubes, self.target = cubes, target
        self.pours = Pours(_cubes(cubes))
        self.prior = BoxUniform(torch.zeros(3), torch.ones(3))
        self.actions = grid(HEIGHTS, PLACES, RATES)
        self.simulator = SimulatorModel(
            self.pours.images, parameter_names=self.pours.parameter_names
        )

    def summaries(
        self, images: Tensor, *, num_components: int = 36
    ) -> dict[str, Summary]:
        """Return the summaries by name, delta = 0 first, as in the paper.

        Args:
            images: Of the round, to fit principal components to, shape (n, 22500).
            num_components: Of these, at most.
        """
        pca = ImagePCA(images, num_components)
        return {"pca": pca, "mesh coverage": mesh_coverage}

    def effects(self) -> list[Effect]:
        """Return what a real pour may have and the model lacks."""
        return make_effects()

    def _options(self) -> dict[str, Any]:
        return {
            "cubes": self.cubes,
            "target": self.target,
            "theta_true": self.theta_true,
        }


def grid(
    heights: Sequence[float], places: Sequence[float], rates: Sequence[float]
) -> DiscreteActions:
    """Return all combinations, the rate varying fastest."""
    rows = [*itertools.product(heights, places, rates)]
    return DiscreteActions(
        torch.tensor(rows, dtype=torch.float32),
        names=list(ACTION_NAMES),
        units=list(ACTION_UNITS),
    )


_cubes = cubes  # the option has the same name
