r"""What campaigns on a material know of each action and summary, and what they believe.

As in ``benchmarks.pouring.learned``, with eight parameters and fewer pours: one
likelihood for each place of the bucket along y and summary, which takes the height and
the rate beside theta, and a belief by weights on points of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc
from torch import Tensor

from benchmarks.pouring.bank import read, read_parts
from benchmarks.pouring.learned import (
    ByAction,
    Learned,
    best_power,
    both_summaries,
    summaries_of,
)
from benchmarks.pouring.likelihood import ImageLikelihood, observed
from sbi_active.inference.sampling.gaussian_process import (
    GaussianProcess,
    ProcessSettings,
)
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of, intersection_volume
from sbi_active.tasks.pouring.real import COMPARED_AT, HEIGHTS, RATES
from sbi_active.tasks.pouring.task import PLACES

Array = NDArray[Any]

NUM_PARAMETERS = 8
LOG_NUM_POINTS = 14
NUM_FOLDS = 3
NUM_DRAWS = 1_000  # of the prior, that left-out pours are judged on
PARTS = ("prior", "compared")


class PointBelief:
    """A belief as weights on 16,384 points that fill the prior evenly.

    Args:
        log_weight: Up to a constant, shape (n,).
    """

    def __init__(self, log_weight: Array) -> None:
        self.log_weight = log_weight - log_sum_exp(log_weight)

    @staticmethod
    def points() -> Array:
        """Return the points, of Sobol's sequence, shape (n, 8)."""
        sobol = qmc.Sobol(NUM_PARAMETERS, seed=0)  # pyright: ignore[reportCallIssue]
        return sobol.random_base2(LOG_NUM_POINTS)

    @classmethod
    def uniform(cls) -> PointBelief:
        """Return the prior."""
        return cls(np.zeros(2**LOG_NUM_POINTS))

    def draws(self, num: int, seed: int) -> Array:
        """Return draws by a seed, shape (num, 8)."""
        rng = np.random.default_rng(seed)
        return self.points()[rng.choice(2**LOG_NUM_POINTS, num, p=self.weight)]

    @property
    def weight(self) -> Array:
        """Shape (n,), of sum 1."""
        weight = np.exp(self.log_weight)
        return weight / weight.sum()


def beside(theta: Array, action: Array) -> Array:
    """Return theta (n, 8) beside height and rate, which are scaled to [0, 1]."""
    low, high = np.array([HEIGHTS[0], RATES[0]]), np.array([HEIGHTS[-1], RATES[-1]])
    scaled = (np.atleast_2d(action)[:, [0, 2]] - low) / (high - low)
    return np.concatenate([theta, np.broadcast_to(scaled, (len(theta), 2))], 1)


def cross_validated(
    theta: Array, action: Array, summary: Array, is_empty: Array
) -> ImageLikelihood:
    """Return the likelihood of a place, with the power that tells left-out pours best.

    Args:
        theta: Shape (n, 8).
        action: Shape (n, 3).
        summary: Shape (n, q).
        is_empty: Whether no cube is in view, shape (n,).
    """
    draws = np.random.default_rng(0).random((NUM_DRAWS, NUM_PARAMETERS))
    both, num = beside(theta, action), len(theta)
    log_p, own = np.zeros((num, NUM_DRAWS)), np.zeros(num)
    for k in range(NUM_FOLDS):
        out = np.arange(num) % NUM_FOLDS == k
        fitted = ImageLikelihood.fit(
            both[~out], summary[~out], is_empty[~out], num_wanted=NUM_PARAMETERS
        )
        for one in np.unique(action[out], axis=0):
            mine = np.nonzero(out & (action == one).all(1))[0]
            seen = [observed(fitted, summary[i], bool(is_empty[i])) for i in mine]
            log_p[mine] = fitted.at_each(beside(draws, one), seen)
            own[mine] = np.diag(fitted.at_each(both[mine], seen))
    whole = ImageLikelihood.fit(both, summary, is_empty, num_wanted=NUM_PARAMETERS)
    return replace(whole, power=best_power(log_p, own))


def learn(folder: Path) -> ByAction:
    """Return what is learned of a bank, of each place of the bucket by itself."""
    task: Any = get_task("pouring_real")
    rows = read_parts(folder, PARTS)
    mesh, small = summaries_of(rows, task)
    theta, action = rows.theta.double().numpy(), rows.action.double().numpy()
    found: list[dict[float, Learned]] = [{}, {}]
    for place in PLACES:
        mine = action[:, 1] == place
        for own, one in zip(
            found, both_summaries(mesh[mine], small[mine]), strict=True
        ):
            fitted = cross_validated(theta[mine], action[mine], *one[:2])
            own[place] = Learned(fitted, *one[2:])
    actions = task.actions.values
    places = actions[:, 1].tolist()
    return ByAction(
        [[by_place[place] for place in places] for by_place in found],
        actions,
        lambda theta, action: beside(theta, action.double().numpy()),
    )


@dataclass(frozen=True)
class Overlap:
    """What a pour of the model shares with pours of the material, as theta tells.

    Attributes:
        process: Of the intersection volume, mm summed over pixels, without the chaos.
        explained: Share of the variance of left-out pours.
        num: Pours behind it.
    """

    process: GaussianProcess
    explained: float
    num: int

    @staticmethod
    def fit(theta: Array, volume: Array) -> Overlap:
        """Learn from pours: theta (n, 8) and volumes (n,)."""
        process = GaussianProcess.fit(
            2 * theta - 1,
            volume[:, None],
            noise="learned",
            settings=ProcessSettings(degree=1),
        )
        missed = float((process.left_out**2).mean() / volume.var())
        return Overlap(process, 1 - missed, len(theta))

    def mean(self, belief: PointBelief) -> float:
        """Return the expectation under a belief: InterVol of all its draws."""
        return float(belief.weight @ self.at_points)

    @cached_property
    def at_points(self) -> Array:
        """What it is at the points of a belief, shape (n,)."""
        return self.process.predict(2 * PointBelief.points() - 1)[0][:, 0]


def compared_pours(folder: Path, real: Tensor) -> Overlap:
    """Return the overlap with images of a material, shape (k, 22500), at the mean."""
    task: Any = get_task("pouring_real")
    theta, volume = [], []
    for part in PARTS:
        rows = read(folder, part)
        mine = (rows.action - torch.tensor(COMPARED_AT)).abs().amax(1) < 1e-5
        images = images_of(rows.poses[mine.numpy()], task.pours.particles)
        each = [intersection_volume(one, images) for one in real]
        theta.append(rows.theta[mine].double().numpy())
        volume.append(torch.stack(each).mean(0).double().numpy())
    return Overlap.fit(np.concatenate(theta), np.concatenate(volume))
