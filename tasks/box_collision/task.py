"""The box collision of Kim & Matsubara (2025), section 5.3."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import DiscreteActions
from sbi_active.criticism import Effect
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.base import Task
from sbi_active.tasks.box_collision.effects import make_effects
from sbi_active.tasks.box_collision.model import (
    ACTIONS,
    CHANNEL_NAMES,
    LEFT_TABLE,
    PARAMETER_NAMES,
    positions,
)
from sbi_active.tasks.box_collision.scene import LocalScene, load_mujoco

__all__ = ["BoxCollisionTask", "LeftTable", "Variant"]

Variant = Literal["centered", "off_center"]
LeftTable = Literal["invalid", "paper"]

OFFSETS = {"centered": 0.0, "off_center": 0.03}  # m
LEFT_TABLES = {"invalid": math.nan, "paper": LEFT_TABLE}
TARGETS = {1: (0.8, 0.8, 0.8), 2: (0.2, 0.2, 0.2)}
REPRODUCED = (3.0, 5.0, 7.0)  # m/s
NUM_REPRODUCED = 250


class BoxCollisionTask(Task):
    r"""Push a cube with another and find two frictions and a density.

    The parameters are the frictions of table and cube and the cube's density over 1000
    kg/m^3, each uniform on [0, 1]; the action is the speed of the pusher, 0 to 20 m/s
    in steps of .5; x is the cube's position in m after 100 frames, 1 s. Too slow a
    pusher does not reach the cube, and too fast a one sends it off the table: the
    outcome is then invalid, NaN.

    A central push leaves y = 0 and z = .075, so that x is one number but for noise. In
    the variant "off_center" the pusher meets the cube 3 cm beside its middle; the cube
    turns, and y tells as well.

    Args:
        target: The real system: 1 of high friction and density, (.8, .8, .8), or 2 of
            low, (.2, .2, .2).
        variant: "centered", as in the paper, or "off_center".
        noise: Standard deviation of each coordinate, m. 0 is the paper's: such a
            simulator has no posterior density, and estimators refuse it.
        left_table: Outcome off the table: "invalid", or the paper's code (-1, -1, -1),
            which receives noise as any position.
        theta_true: Another real system, within [0, 1]; None takes the target's.

    Attributes:
        num_rounds: Trials in the paper.

    Raises:
        ImportError: If MuJoCo is not installed.
        ValueError: If the target, the variant or the code is unknown, ``theta_true``
            leaves the box, or the noise is negative.

    References:
        Kim & Matsubara, Applied Intelligence 2025, section 5.3, Table 2, Figs. 7-9.

    Example:
        >>> task = BoxCollisionTask(target=2)
        >>> task.simulator.mean(task.theta_true[None], torch.tensor([[1.0]])).shape
        torch.Size([1, 3])
    """

    name = "box_collision"
    num_rounds = 6

    def __init__(
        self,
        *,
        target: Literal[1, 2] = 1,
        variant: Variant = "centered",
        noise: float = 0.005,
        left_table: LeftTable = "invalid",
        theta_true: Sequence[float] | Tensor | None = None,
    ) -> None:
        load_mujoco()
        _require("target", target, TARGETS)
        _require("variant", variant, OFFSETS)
        _require("left_table", left_table, LEFT_TABLES)
        truth = TARGETS[target] if theta_true is None else theta_true
        self.theta_true = torch.as_tensor(truth, dtype=torch.float32)
        inside = (self.theta_true >= 0) & (self.theta_true <= 1)
        if self.theta_true.shape != (3,) or not bool(inside.all()):
            raise ValueError(
                f"expected theta_true of three numbers within [0, 1]; got {theta_true};"
                " choose another truth"
            )
        self.target, self.variant, self.left_table = target, variant, left_table
        self.noise = noise
        self.prior = BoxUniform(torch.zeros(3), torch.ones(3))
        self.actions = DiscreteActions(ACTIONS, names=["speed"], units=["m/s"])
        self.simulator = SimulatorModel(
            positions,
            noise=GaussianNoise(noise),
            setup=partial(
                LocalScene,
                offset=OFFSETS[variant],
                left_table=LEFT_TABLES[left_table],
            ),
            parameter_names=PARAMETER_NAMES,
            channel_names=CHANNEL_NAMES,
        )

    def effects(self) -> list[Effect]:
        """Return what a real table may have and the scene lacks."""
        return make_effects()

    def reproduction_error(
        self,
        belief: Distribution,
        action: Tensor | float,
        *,
        num_samples: int = NUM_REPRODUCED,
        seed: int = 0,
    ) -> float:
        r"""Return how far the tuned simulator is from the real system at an action.

        .. math::
            \mathrm{RepErr}(\xi) = \frac{1}{N} \sum_i
            \| f_\xi(\theta_i) - f_\xi(\theta^{\mathrm{true}}) \|, \quad \theta_i \sim b

        where :math:`f` is (-1, -1, -1) off the table, as in the paper.

        Args:
            belief: Any distribution over the parameters.
            action: Shape (1,), or a number.
            num_samples: Draws N.
            seed: Of the draws.

        Returns:
            Meters; :meth:`reproduction_table` has the units of the paper's table.
        """
        with forked_generators(seed, "reproduction"):
            theta = belief.sample(torch.Size([num_samples]))
        row = torch.as_tensor(action, dtype=torch.float32).reshape(1, 1)
        rows = torch.cat([theta.to(self.theta_true), self.theta_true[None]])
        x = self.simulator.mean(rows, row.expand(len(rows), 1))
        x = x.nan_to_num(nan=LEFT_TABLE)
        return float((x[:-1] - x[-1]).norm(dim=1).mean())

    def reproduction_table(
        self, belief: Distribution, *, seed: int = 0
    ) -> dict[float, float]:
        """Return the reproduction error by speed, in the paper's units of 1e-3 m."""
        return {
            speed: 1e3 * self.reproduction_error(belief, speed, seed=seed)
            for speed in REPRODUCED
        }

    def _options(self) -> dict[str, Any]:
        return {
            "target": self.target,
            "variant": self.variant,
            "noise": self.noise,
            "left_table": self.left_table,
            "theta_true": self.theta_true,
        }


def _require(name: str, value: Any, valid: dict[Any, Any]) -> None:
    if value not in valid:
        raise ValueError(
            f"expected {name} among {', '.join(map(repr, valid))}; got {value!r}; "
            "choose one of these"
        )
