"""The worlds of the benchmark: their physics, equivalences, and what a case reveals."""

import numpy as np
import pytest
import torch

from benchmarks.criticism.cases import (
    draw_case,
)
from benchmarks.criticism.worlds import get_world
from benchmarks.criticism.worlds.sliding_block import (
    EDGE,
    GRAVITY,
    NOISE_SD,
    TIMES,
    slide,
)


def exact_position(near: float, far: float, speed: float, time: float) -> float:
    """Constant deceleration in each zone."""
    v, sign = abs(speed), np.sign(speed)
    t = min(time, v / (near * GRAVITY))
    if v * t - 0.5 * near * GRAVITY * t**2 <= EDGE:
        return sign * (v * t - 0.5 * near * GRAVITY * t**2)
    at_edge = np.sqrt(v**2 - 2 * near * GRAVITY * EDGE)
    t = min(time - (v - at_edge) / (near * GRAVITY), at_edge / (far * GRAVITY))
    return sign * (EDGE + at_edge * t - 0.5 * far * GRAVITY * t**2)


def test_the_block_follows_the_closed_form():
    rng = np.random.default_rng(0)
    theta = torch.tensor(rng.uniform(0.1, 0.5, (300, 2)))
    speed = torch.tensor(rng.choice([-1, 1], (300, 1)) * rng.uniform(1, 3, (300, 1)))
    x = slide(theta, speed, times=TIMES)
    exact = [
        [exact_position(*t.tolist(), float(v), time) for time in TIMES]
        for t, v in zip(theta, speed, strict=True)
    ]
    assert (x - torch.tensor(exact)).abs().max() < 0.15 * NOISE_SD


def test_non_centrality_is_weighted_least_squares_where_the_model_is_linear():
    world = get_world("A")
    case = next(
        c
        for c in (draw_case(world, "library", i) for i in range(60))
        if c.truth.names == ("drift",) and float(c.truth.theta.abs().max()) < 3
    )
    xi = case.truth.action.double()[:, 0]
    design = torch.stack([torch.exp(3 - xi), xi], -1)
    shift = case.truth.strengths[0].double() * torch.arange(8)
    left = shift.flatten() - design @ torch.linalg.lstsq(design, shift.T).solution[:, 0]
    assert case.truth.non_centrality == pytest.approx(float(left.square().sum()), 1e-4)
