"""A campaign on what was learned of a bank, round by round.

A belief over [0, 1]^3 as a density on a grid.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.learned import Earlier
from sbi_active.seeding import derive_seed, forked_generators

SIDE = 20  # cells along each parameter


class GridBelief:
    r"""A density that is constant within each of 20 x 20 x 20 cells.

    Args:
        log_density: At the middles of the cells, up to a constant, shape (8000,).
    """

    def __init__(self, log_density: Tensor) -> None:
        self.log_density = log_density.double().log_softmax(0) + 3 * math.log(SIDE)

    @staticmethod
    def middles() -> Tensor:
        """Return the middles of the cells, shape (8000, 3)."""
        line = (torch.arange(SIDE) + 0.5) / SIDE
        return torch.cartesian_prod(line, line, line)

    @classmethod
    def uniform(cls) -> GridBelief:
        """Return the prior."""
        return cls(torch.zeros(SIDE**3))

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return log densities, (..., 3) -> (...)."""
        cell = (theta * SIDE).long().clamp(0, SIDE - 1)
        index = (cell[..., 0] * SIDE + cell[..., 1]) * SIDE + cell[..., 2]
        return self.log_density[index]

    def sample(self, shape: torch.Size) -> Tensor:
        """Return draws, shape (n, 3)."""
        index = self.log_density.softmax(0).multinomial(shape[0], replacement=True)
        return self.middles()[index] + (torch.rand(shape[0], 3) - 0.5) / SIDE

    def draws(self, num: int, seed: int) -> np.ndarray:
        """Return draws by a seed, shape (num, 3)."""
        with forked_generators(seed):
            return self.sample(torch.Size([num])).double().numpy()


#: The product of k trials is taken to the power k^-TEMPERED: what is chosen for its
#: gain is chosen for the error of its learned likelihood too. From seeds 100 to 149.
TEMPERED = 0.25


@dataclass(frozen=True)
class Round:
    """What a round chose, saw and believes.

    Attributes:
        index: Number of the round, from 0.
        delta: Number of the summary.
        place: Number of the action.
        action: Shape (3,).
        image: Shape (22500,).
        gain: Expected gains by delta and action; NaN where nothing was asked.
        belief: Belief after the trial.
        cpu_design: CPU seconds of the choice.
        cpu_trial: CPU seconds of the trial and the belief.
    """

    index: int
    delta: int
    place: int
    action: Tensor
    image: Tensor
    gain: np.ndarray
    belief: Any
    cpu_design: float
    cpu_trial: float

    def row(self) -> dict[str, object]:
        """Return the columns that all campaigns have."""
        place = zip(("height", "position", "rate"), self.action.tolist(), strict=True)
        return {
            "round": self.index + 1,
            **dict(place),
            "delta": self.delta,
            "eig": float(self.gain[self.delta, self.place]),
            "cpu_design": self.cpu_design,
            "cpu_trial": self.cpu_trial,
        }


def rounds(
    task: Any,
    learned: Any,
    believed: Callable[[np.ndarray], Any],
    points: np.ndarray,
    *,
    num: int,
    seed: int,
    is_active: bool,
    tempered: float = TEMPERED,
    name: tuple[str, ...] = (),
) -> Iterator[Round]:
    """Yield the rounds of a campaign.

    Args:
        task: Task whose real system is asked.
        learned: Likelihoods of images, with ``actions``, ``gains`` and
            ``log_likelihood``.
        believed: Belief by its log density at the points, up to a constant.
        points: Parameters that carry a belief, shape (n, d).
        num: Number of rounds.
        seed: Seed of the campaign.
        is_active: Whether actions are chosen by their gain, or at random.
        tempered: Exponent of the number of trials in the power of their product.
        name: Names beside the seed of what is real.
    """
    total = np.zeros(len(points))
    belief, earlier = believed(total), Earlier(list)
    for index in range(num):
        start = time.process_time()
        gain = np.full((2, len(learned.actions)), np.nan)
        if is_active:
            own_seed = derive_seed(seed, "gain", index)
            gain = learned.gains(belief, earlier, own_seed)
            choice = int(gain.argmax())
        else:
            with forked_generators(derive_seed(seed, "action", index)):
                choice = int(torch.randint(gain.size, ()))
        delta, place = divmod(choice, gain.shape[1])
        action = learned.actions[place]
        designed = time.process_time()
        own_seed = derive_seed(seed, "real", *name, index)
        image = task.real_system(action, seed=own_seed)
        total += learned.log_likelihood(points, image, delta, place, earlier)
        belief = believed(total * (index + 1.0) ** -tempered)
        ended = time.process_time()
        yield Round(
            *(index, delta, place, action, image, gain, belief),
            *(designed - start, ended - designed),
        )
