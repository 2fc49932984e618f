"""Attacks by shared memory: views, buffers, arguments changed in place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import joblib
import numpy as np
import torch
from torch import Tensor

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.simulations import (
    FEW_WAYS,
    WAYS,
    change_torch,
    quietly,
    require,
    require_raises,
    rows_of,
    seeded,
)
from sbi_active import BoxActions, DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.simulation import (
    Workers,
    simulate,
)

ATTACKS = Attacks()


class Data:
    """What a physics engine works in."""

    def __init__(self) -> None:
        self.qpos = np.zeros(3)


def data_row(theta: np.ndarray, action: np.ndarray, rng: Any, *, context: Data) -> Any:
    context.qpos[:2] = theta[0], -theta[0]
    return context.qpos[:2]


def data_last(theta: np.ndarray, action: np.ndarray, rng: Any, *, context: Data) -> Any:
    context.qpos[:] = theta[0], 1, -theta[0]
    return context.qpos[::2]


@ATTACKS.add("a row function returns a view of its data", cases=tuple(WAYS))
def view_of_data(way: str) -> None:
    for function in (data_row, data_last):
        for noise in (None, GaussianNoise(0.0)):
            model = SimulatorModel(function, batched=False, setup=Data, noise=noise)
            theta = rows_of(300)[0]
            require(quietly(model, **WAYS[way]), torch.cat([theta, -theta], 1))


class Buffer:
    """Returns part of the array that it fills again in each call."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        dtype = torch.float64 if "64" in kind else torch.float32
        self.buffer = torch.zeros(5_000, 4, dtype=dtype)

    def fill(self, theta: Tensor) -> Any:
        part = self.buffer[: len(theta), 1:2]
        part.copy_(2 * theta)
        return part.numpy() if "numpy" in self.kind else part

    def __call__(self, theta: Tensor, action: Tensor) -> Any:
        return self.fill(theta)


def with_seeds(buffer: Buffer) -> Callable[..., Any]:
    """Return the same as a simulator with seeds."""
    return lambda theta, action, seeds: buffer.fill(theta)


KINDS = ("torch", "numpy", "torch 64", "numpy 64")


@ATTACKS.add(
    "a simulator returns its own buffer",
    cases=[(kind, way) for kind in KINDS for way in FEW_WAYS],
)
def own_buffer(case: tuple[str, str]) -> None:
    kind, way = case
    for simulator in (Buffer(kind), with_seeds(Buffer(kind))):
        require(quietly(simulator, 700, **WAYS[way]), 2 * rows_of(700)[0])


@ATTACKS.add(
    "its own buffer, in rounds of joblib", cases=("sequential", "multiprocessing")
)
def buffer_in_rounds(backend: str) -> None:
    with joblib.parallel_config(backend=backend):
        for simulator in (Buffer("torch"), with_seeds(Buffer("torch"))):
            rows = quietly(simulator, 700, workers=2, batch_size=60)
            require(rows, 2 * rows_of(700)[0])


@ATTACKS.add("the mean of a model that returns its own buffer", cases=KINDS)
def mean_of_buffer(kind: str) -> None:
    model = SimulatorModel(Buffer(kind), noise=GaussianNoise(1.0))
    theta, action = rows_of(40)
    mean = model.mean(theta, action)
    model.mean(9 * theta, action)
    assert torch.equal(mean.float(), 2 * theta)


@ATTACKS.add("a random buffer passes for a noise-free function")
def random_buffer(_: str) -> None:
    buffer = torch.zeros(50, 1)
    model = SimulatorModel(
        lambda theta, action: buffer[: len(theta)].normal_(), noise=GaussianNoise(1.0)
    )
    require_raises(ValueError, "noise-free fn", lambda: model.mean(*rows_of(40)))


def change_numpy(theta: Tensor, action: Tensor, seeds: Tensor) -> None:
    theta.numpy()[:] = -1
    action.numpy()[:] += 5
    seeds.numpy()[:] = 3


def forget(theta: Tensor, action: Tensor, seeds: Tensor) -> None:
    for rows in (theta, action):
        rows.fill_(torch.nan)


CHANGES = {"torch": change_torch, "numpy": change_numpy, "NaN": forget}


@ATTACKS.add(
    "a simulator changes its arguments in place",
    cases=[(change, way) for change in CHANGES for way in FEW_WAYS],
)
def changed_arguments(case: tuple[str, str]) -> None:
    change, way = CHANGES[case[0]], WAYS[case[1]]

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = seeded(theta, action, seeds)
        change(theta, action, seeds)
        return x

    def blocks(theta: Tensor, action: Tensor) -> Tensor:
        x = theta + torch.randn_like(theta)
        change(theta, action, torch.zeros(1))
        return x

    theta, action = rows_of(600)
    for hostile, clean in (
        (simulator, seeded),
        (SimulatorModel(simulator), seeded),
        (blocks, lambda theta, action: theta + torch.randn_like(theta)),
    ):
        rows = simulate(hostile, theta, action, seed=7, **way)
        require(rows, quietly(clean, 600).x)
        for kept, given in zip(rows_of(600), (theta, action), strict=True):
            assert torch.equal(kept, given), "the caller's tensor changed"
        assert torch.equal(rows.theta, theta), "the simulations' theta changed"


@ATTACKS.add("rows that raise after they changed theta", cases=tuple(WAYS))
def changed_then_raised(way: str) -> None:
    guilty = (5, 70, 200)

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = theta.clone()
        theta += 1000
        if bool(torch.isin(x, torch.tensor(guilty)).any()):
            raise RuntimeError("no")
        return x

    for retries in (0, 2):
        workers = replace(Workers.of(WAYS[way].get("workers")), num_retries=retries)
        rows = quietly(simulator, **{**WAYS[way], "workers": workers})
        require(rows, rows_of(300)[0], missing=guilty)


@ATTACKS.add("a simulator keeps its arguments and changes them later")
def kept_arguments(_: str) -> None:
    kept: list[Tensor] = []

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        for old in kept:
            old.fill_(torch.nan)
        kept.extend([theta, action])
        return theta + action

    rows = quietly(simulator, batch_size=50)
    require(rows, rows_of(300)[0] + 1)
    assert rows.theta.isfinite().all()


@ATTACKS.add("theta is a view that shares its rows", cases=FEW_WAYS)
def expanded_theta(way: str) -> None:
    theta = torch.tensor([[2.0]]).expand(300, 1)

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        theta += 1
        return theta

    rows = simulate(simulator, theta, rows_of(300)[1], seed=0, **WAYS[way])
    assert (rows.x == 3).all()
    assert (theta == 2).all()


@ATTACKS.add(
    "the caller changes its arrays afterwards",
    cases=("simulations", "noise", "times", "actions", "box", "trials", "condition"),
)
def changed_afterwards(what: str) -> None:
    numbers = np.arange(1.0, 5.0, dtype=np.float64)
    single = numbers.astype(np.float32)
    theta = torch.ones(4, 1)
    kept = {
        "simulations": lambda: simulate(seeded, theta, theta, seed=0).theta,
        "noise": lambda: GaussianNoise(torch.from_numpy(numbers)).parameters,
        "times": lambda: SimulatorModel(seeded, sample_times=numbers).sample_times,  # pyright: ignore[reportArgumentType]
        "actions": lambda: DiscreteActions(single).values,
        "box": lambda: BoxActions(single, single + 1).low,
        "trials": lambda: Trials(numbers, numbers).action,
        "condition": lambda: torch.cat(
            [outcome_rows(theta, [1]), action_rows(theta, 1)]
        ),
    }[what]()
    assert kept is not None
    before = kept.clone()
    for array in (numbers, single, theta):
        array += 7
    assert torch.equal(kept, before)
