r"""World B: a block on two friction zones, seen six times by a camera.

The block is pushed at a signed speed between 1 and 3 m/s; the camera has an error of
5 mm. World C is the same block with its whole trajectory.

A block pushed along a mat with two friction zones, many rows at once.

.. math::
    \dot v = -\mu(x)\, g \operatorname{sign}(v) + a(x, v), \qquad
    \mu(x) = \mu_1 \text{ for } |x| < b, \quad \mu_2 \text{ beyond},

from :math:`x = 0` at the signed speed :math:`\xi`. Friction is implicit: the block
sticks in a step in which friction can absorb its momentum. A step across the edge of a
zone has the friction of both zones in proportion to its path, so that the positions
are continuous in the parameters.

World C: the block's whole trajectory, with errors correlated along it.

Fifty camera samples a trial. The errors are first-order autoregressive,

    e_k = rho e_{k-1} + sqrt(1 - rho^2) s n_k,

with a marginal standard deviation s of 5 mm and rho from 0 to .98 by the case. Only the
marginal standard deviation is declared, as a camera's data sheet would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.criticism.worlds.world import (
    World,
    effect,
    half_normal,
    noise_inflation,
    normal,
    shifted,
    signed_uniform,
    stretched,
    uniform,
)
from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect

GRAVITY = 9.81  # m/s^2
EDGE = 0.5  # b, m
STEP = 0.02  # s
STRIBECK_SPEED = 0.5  # m/s
MAGNET = (0.7, 0.2)  # position and width, m
REBOUND = 0.4  # of the speed, at the wall

Strength = Tensor | float


def slide(
    theta: Tensor,
    action: Tensor,
    *,
    times: Sequence[float],
    quadratic_drag: Strength = 0.0,
    viscous_drag: Strength = 0.0,
    tilt: Strength = 0.0,
    time_offset: Strength = 0.0,
    stribeck: Strength = 0.0,
    magnet: Strength = 0.0,
    edge_shift: Strength = 0.0,
    wall: Strength = np.inf,
) -> Tensor:
    r"""Return the block's position at the given times.

    Every effect is a number, or one a row.

    Args:
        theta: :math:`(\mu_1, \mu_2)`, shape (n, 2).
        action: Signed speed in m/s, shape (n, 1).
        times: When the camera reads, s; k of them.
        quadratic_drag: :math:`a = -c\, v |v|`, 1/m.
        viscous_drag: :math:`a = -c\, v`, 1/s.
        tilt: Slope against the positive direction, rad.
        time_offset: Of the camera's clock, s.
        stribeck: Friction :math:`\mu (1 + c\, e^{-|v| / 0.5})`.
        magnet: Peak of a force around x = 0.7 m, m/s^2.
        edge_shift: Of both edges between the zones, m.
        wall: Position of a wall that throws the block back, m.

    Returns:
        Positions in m, shape (n, k), in the dtype of theta.

    Example:
        >>> slide(torch.tensor([[0.2, 0.2]]), torch.tensor([[1.0]]), times=[2.0])
        tensor([[0.2548]])
    """
    num = len(theta)
    near, far = np.ascontiguousarray(_array(theta).T)
    speed = _array(action)[:, 0].copy()
    edge = EDGE + _row(edge_shift)
    drag, viscous, slope = (
        _row(quadratic_drag),
        _row(viscous_drag),
        GRAVITY * np.sin(_row(tilt)),
    )
    creep, pull, stop = _row(stribeck), _row(magnet), _row(wall)
    offset = _row(time_offset)
    clock = np.maximum(np.asarray(times)[None, :] + offset[:, None], 0.0)

    num_steps = int(np.ceil(clock.max() / STEP)) + 1
    path = np.empty((num_steps + 1, num))
    position = np.zeros(num)
    for i in range(num_steps + 1):
        path[i] = position
        force = -slope - speed * (viscous + drag * np.abs(speed))
        if pull.any():
            force = force + pull * np.exp(
                -0.5 * ((position - MAGNET[0]) / MAGNET[1]) ** 2
            )
        # Where this step would lead under the friction of the zone that it starts in.
        here = np.where(np.abs(position) < edge, near, far)
        ahead = STEP * (speed - 0.5 * STEP * GRAVITY * here * np.sign(speed))
        inside = _share_inside(position, position + ahead, edge)
        friction = far + (near - far) * inside
        if creep.any():
            friction = friction * (1 + creep * np.exp(-np.abs(speed) / STRIBECK_SPEED))
        free = speed + STEP * force
        absorbed = STEP * GRAVITY * friction
        after = np.sign(free) * np.maximum(np.abs(free) - absorbed, 0.0)
        moving = np.minimum(np.abs(free) / absorbed, 1.0)  # share of the step
        position = position + 0.5 * STEP * moving * (speed + after)
        if np.isfinite(stop).any():
            hit = (position > stop) & (after > 0)
            after = np.where(hit, -REBOUND * after, after)
        if not speed.any() and not after.any():  # at rest for good
            path[i + 1 :] = position
            break
        speed = after

    low = np.minimum((clock / STEP).astype(int), num_steps - 1)
    weight = clock / STEP - low
    row = np.arange(num)[:, None]
    x = (1 - weight) * path[low, row] + weight * path[low + 1, row]
    return torch.from_numpy(x).to(theta.dtype)


def _share_inside(start: np.ndarray, end: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Return the share of the path from start to end that lies within +-edge."""
    length = end - start
    covered = np.clip(end, -edge, edge) - np.clip(start, -edge, edge)
    at_rest = np.abs(length) < 1e-12
    share = covered / np.where(at_rest, 1.0, length)
    return np.where(at_rest, np.abs(start) < edge, share)


def _array(value: Tensor) -> np.ndarray:
    return value.detach().cpu().numpy().astype(np.float64)


def _row(value: Strength) -> np.ndarray:
    """Return an effect as shape (n,) or (1,)."""
    return np.atleast_1d(np.asarray(value, dtype=np.float64))


NOISE_SD = 0.005  # m
TIMES = (0.1, 0.25, 0.5, 0.8, 1.2, 2.0)  # s
SPEEDS = (1.0, 1.5, 2.0, 2.5, 3.0)  # m/s
ALIASES = {"stribeck": frozenset({"speed gain", "speed offset"})}


def library() -> list[Effect]:
    """Return the declared effects."""
    return [
        Effect.keyword("quadratic drag", prior=half_normal(0.2), units="1/m"),
        Effect.keyword("viscous drag", prior=half_normal(0.4), units="1/s"),
        Effect.keyword("tilt", prior=normal(math.radians(2.0)), units="rad"),
        effect("speed gain", "action", normal(0.08), stretched),
        effect("speed offset", "action", normal(0.1), shifted, units="m/s"),
        effect("camera bias", "observation", normal(0.02), shifted, units="m"),
        effect("camera scale", "observation", normal(0.05), stretched),
        Effect.keyword(
            "time offset", prior=normal(0.03), units="s", family="observation"
        ),
    ]


def outside() -> list[Effect]:
    """Return the effects that the library lacks."""
    return [
        Effect.keyword("stribeck", prior=uniform(0.3, 0.8)),
        Effect.keyword("magnet", prior=signed_uniform(0.4, 1.2), units="m/s^2"),
        Effect.keyword("edge shift", prior=uniform(-0.25, -0.1), units="m"),
        Effect.keyword("wall", prior=uniform(0.6, 1.2), units="m", null=torch.inf),
    ]


def make_world() -> World:
    """Return world B."""
    speeds = (*(-v for v in reversed(SPEEDS)), *SPEEDS)
    return World(
        name="B",
        model=SimulatorModel(
            partial(slide, times=TIMES),
            noise=GaussianNoise(NOISE_SD),
            parameter_names=["friction_near", "friction_far"],
            channel_names=[f"x({t:g} s)" for t in TIMES],
        ),
        prior=BoxUniform(0.1 * torch.ones(2), 0.5 * torch.ones(2)),
        actions=DiscreteActions(speeds, names=["speed"], units=["m/s"]),
        noise_sd=NOISE_SD,
        library=library,
        scatter=noise_inflation(2.0),
        outside=outside(),
        aliases=ALIASES,
        formulas={"camera bias": frozenset({"1"}), "camera scale": frozenset({"x"})},
    )


TRAJECTORY = tuple(np.round(np.linspace(0.04, 2.0, 50), 2).tolist())  # s
CORRELATIONS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)


def make_trajectories() -> World:
    """Return world C."""
    block = make_world()
    model = SimulatorModel(
        partial(slide, times=TRAJECTORY),
        noise=GaussianNoise(NOISE_SD),
        parameter_names=block.model.parameter_names,
    )
    return replace(
        block, name="C", model=model, correlations=CORRELATIONS, sample_times=TRAJECTORY
    )
