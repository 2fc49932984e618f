r"""Few numbers of a depth image, and how they follow from parameters and effects.

A picture is twelve numbers, roots of counts, so that their chaos is about as large
where much is in view as where little is: how many particles' worth is covered in six
bands along y, within 3 cm of the middle along x and beyond; how much of it is flat, and
how much no steeper than a third; and how much volume there is, with heights as they are
and squared. How much is flat tells the particles' shape, whatever theta is: a box lies
on a face. They are taken with the picture shifted by five
distances along y, between which the camera's offset interpolates; its gain multiplies
the volume, and the rest is a Gaussian process over theta and the strengths of the
effects, for each action.

What left-out pours miss of it, chaos and error together, is the noise, of the half of
them that have the weaker effects, as one effect alone is weaker than seven at a time:
numbers are whitened by its root, and larger still by the factor that leaves one in
twenty of these pours beyond the chi-square's 95 % point. What is compared is the mean
of a few pours of one action, since the emulator's error is the same in all of them: of
the variance, the share that the process takes for noise is divided by their number.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2
from torch import Tensor

from benchmarks.pouring.loop.worlds import World, poured_effects
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect
from sbi_active.inference.emulation.likelihood import correlation_root
from sbi_active.inference.sampling.gaussian_process import (
    GaussianProcess,
    ProcessSettings,
)
from sbi_active.tasks.pouring.raster import NUM_PIXELS, PIXEL

Array = NDArray[Any]

SHIFTS = (-10, -5, 0, 5, 10)  # pixels along y
NUM_BANDS = 6
CORE = 15  # pixels from the middle along x
COVERED = 0.5  # mm
HIGHEST = 8.0  # sides of a particle: what is above hangs in the bucket
OFFSET = 3 / 8  # of a count before its root (Anscombe, Biometrika 1948)
FLAT, GENTLE = 0.05, 0.3  # slopes
NUM_NUMBERS = NUM_BANDS + 6
VOLUME = (NUM_BANDS + 4, NUM_BANDS + 5)  # place of what the gain multiplies
LIMIT = 0.95  # of the chi-square of left-out pours


def pictures_numbers(images: Tensor, side: float) -> Array:
    """Return the numbers of images (n, 22500) at all shifts, shape (n, 5, 12).

    Args:
        images: Heights in mm.
        side: Of a particle, mm, that counts are in units of.
    """
    x = images.reshape(-1, NUM_PIXELS, NUM_PIXELS).numpy().astype(np.float64)
    x = np.where(x > HIGHEST * side, 0, x)
    pixels = (side / (1e3 * PIXEL)) ** 2
    slope = np.hypot(*np.gradient(x, 1e3 * PIXEL, axis=(1, 2)))
    found = np.empty((len(x), len(SHIFTS), NUM_NUMBERS))
    middle = NUM_PIXELS // 2
    for k, shift in enumerate(SHIFTS):
        moved, steep = shifted(x, shift), shifted(slope, shift)
        covered = moved > COVERED
        along = covered.sum(1).reshape(len(x), NUM_BANDS, -1).sum(2)
        total = covered.sum((1, 2))
        core = covered[:, middle - CORE : middle + CORE].sum((1, 2))
        counts = np.stack(
            [
                *along.T,
                core,
                total - core,
                (covered & (steep < FLAT)).sum((1, 2)),
                (covered & (steep < GENTLE)).sum((1, 2)),
                moved.sum((1, 2)) / side,
                (moved**2).sum((1, 2)) / side**2,
            ],
            1,
        )
        found[:, k] = np.sqrt(counts / pixels + OFFSET)
    return found


def shifted(x: Array, by: int) -> Array:
    """Return pictures (n, 150, 150) moved along y by pixels, with zeros behind."""
    moved = np.zeros_like(x)
    if by >= 0:
        moved[:, :, by:] = x[:, :, : NUM_PIXELS - by]
    else:
        moved[:, :, :by] = x[:, :, -by:]
    return moved


def interpolation(offset: Array) -> Array:
    """Return weights of the shifts at offsets of the camera, m, (n,) -> (n, 5)."""
    place = np.clip(offset / PIXEL, SHIFTS[0], SHIFTS[-1])
    weight = np.ones((len(place), len(SHIFTS)))
    for k, own in enumerate(SHIFTS):
        for other in SHIFTS:
            if other != own:
                weight[:, k] *= (place - other) / (own - other)
    return weight


@dataclass(frozen=True)
class Emulator:
    """What the numbers of a world are at its actions.

    Attributes:
        world: It.
        scales: Of each poured effect's strength, by keyword.
        processes: One an action, of the numbers at all shifts.
        roots: Of the covariance of outcomes at each action, shape (a, 12, 12).
        widened: Factor on the noise, by action.
    """

    world: World
    scales: dict[str, float]
    processes: tuple[GaussianProcess, ...]
    roots: Array
    widened: Array

    @staticmethod
    def fit(
        world: World,
        theta: Tensor,
        action: Tensor,
        effects: dict[str, Array],
        x: Array,
        *,
        averaged: int = 1,
    ) -> Emulator:
        """Learn from pours.

        Args:
            world: Its actions are the trials'.
            theta: Shape (n, d).
            action: Each one of the world's, shape (n, 3).
            effects: By keyword, each of shape (n,).
            x: Numbers, shape (n, 5, 12).
            averaged: Pours behind each outcome of the loop.
        """
        scales = {
            effect.apply.names[0]: float(effect.declared_draws().std())  # type: ignore[attr-defined]
            for effect in poured_effects(world)
        }
        strengths = [effects[name] / scale for name, scale in scales.items()]
        inputs = _inputs(theta, strengths)
        size = np.square(strengths).sum(0)
        processes, roots, widened = [], [], []
        for own in world.actions:
            mine = (action == own).all(1).numpy()
            process = GaussianProcess.fit(
                inputs[mine],
                x[mine].reshape(mine.sum(), -1),
                noise="learned",
                settings=ProcessSettings(degree=1),
            )
            shape = (-1, len(SHIFTS), NUM_NUMBERS)
            missed = process.left_out.reshape(shape)[:, SHIFTS.index(0)]
            missed = missed[size[mine] <= np.median(size[mine])]
            root = np.sqrt((missed**2).mean(0))[:, None] * correlation_root(missed)
            square = (np.linalg.solve(root, missed.T) ** 2).sum(0)
            limit = chi2.ppf(LIMIT, NUM_NUMBERS)
            sd = process.noise_sd.reshape(shape)[0, SHIFTS.index(0)]
            chaos = np.minimum(sd**2 / (missed**2).mean(0), 1).mean()
            processes.append(process)
            roots.append(root * np.sqrt(1 - chaos * (1 - 1 / averaged)))
            widened.append(max(1.0, float(np.sqrt(np.quantile(square, LIMIT) / limit))))
        return Emulator(
            world, scales, tuple(processes), np.stack(roots), np.array(widened)
        )

    def white(self, x: Array, number: int) -> Array:
        """Return numbers (n, 12) at an action in units of their noise."""
        return np.linalg.solve(self.widened[number] * self.roots[number], x.T).T

    def observed(self, images: Tensor, number: int) -> Tensor:
        """Return what the loop compares of images (n, 22500) at an action, (n, 12)."""
        x = pictures_numbers(images, side_of(self.world))[:, SHIFTS.index(0)]
        return torch.from_numpy(self.white(x, number)).float()

    def __call__(self, theta: Tensor, action: Tensor, **phi: Any) -> Tensor:
        """Return whitened numbers, shape (n, 12), without their noise."""
        num = len(theta)
        strength = {
            name: np.broadcast_to(np.asarray(value, float).reshape(-1), num)
            for name, value in phi.items()
        }
        none = np.zeros(num)
        own = [strength.get(k, none) / s for k, s in self.scales.items()]
        inputs = _inputs(theta, own)
        weight = interpolation(strength.get("camera_offset", none))
        gain = np.sqrt(np.maximum(1 + strength.get("camera_gain", none), 1e-3))
        found = np.empty((num, NUM_NUMBERS))
        near = torch.cdist(action.double(), self.world.actions.double()).argmin(1)
        for number, process in enumerate(self.processes):
            mine = np.nonzero(near.numpy() == number)[0]
            if not len(mine):
                continue
            mean = process.mean(inputs[mine]).reshape(-1, len(SHIFTS), NUM_NUMBERS)
            x = (weight[mine][..., None] * mean).sum(1)
            x[:, VOLUME[0]] *= gain[mine]
            x[:, VOLUME[1]] *= gain[mine] ** 2
            found[mine] = self.white(x, number)
        return torch.from_numpy(found)

    def model(self) -> SimulatorModel:
        """Return the simulator of the loop, with noise of unit size."""

        def numbers(theta: Tensor, action: Tensor, **phi: Any) -> Tensor:
            return self(theta, action, **phi)

        # A model knows its effects by the signature of its function.
        keywords = [*self.scales, "camera_offset", "camera_gain"]
        kinds = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
        numbers.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [inspect.Parameter(name, kinds[0]) for name in ("theta", "action")]
            + [inspect.Parameter(name, kinds[1], default=0.0) for name in keywords]
        )
        names = list(self.world.task.pours.parameter_names)
        return SimulatorModel(numbers, noise=GaussianNoise(1.0), parameter_names=names)

    def effects(self) -> list[Effect]:
        """Return the task's effects, as arguments of :meth:`model`."""
        found = []
        for own in self.world.task.effects():
            is_poured = own.hook == "dynamics"
            keyword = own.apply.names[0] if is_poured else own.name.replace(" ", "_")
            given = {"prior": own.prior, "units": own.units, "family": own.family}
            found.append(Effect.keyword(own.name, keyword, **given))
        return found


def side_of(world: World) -> float:
    """Return the mean side of the model's particles, mm."""
    return float(2e3 * world.task.pours.particles.half.mean())


def _inputs(theta: Tensor, strengths: Sequence[Array]) -> Array:
    """Return what the processes take, parameters and then strengths."""
    own = 2 * theta.detach().double().numpy() - 1
    return np.concatenate([own, np.stack(strengths, 1)], 1)
