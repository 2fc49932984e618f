"""Attacks on the engine: hostile simulators, workers that die, interrupted runs."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.robustness import engine_faults, engine_memory, engine_outcomes
from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.simulations import (
    change_torch,
    quietly,
    require,
    require_raises,
    rows_of,
    seeded,
)
from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.seeding import row_normals
from sbi_active.simulation import (
    SimulationInterrupted,
    check_simulator,
    simulate,
)

ATTACKS = Attacks(
    [*engine_memory.ATTACKS, *engine_outcomes.ATTACKS, *engine_faults.ATTACKS]
)


@ATTACKS.add(
    "an interrupt in the default setting",
    cases=("seeds", "rows", "blocks", "two workers"),
    seconds=60.0,
)
def interrupt(kind: str) -> None:
    def slow(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        time.sleep(0.004 * len(theta))
        return seeded(theta, action, seeds)

    def blocks(theta: Tensor, action: Tensor) -> Tensor:
        time.sleep(0.004 * len(theta))
        return theta

    def row(theta: np.ndarray, action: np.ndarray, rng: Any) -> np.ndarray:
        time.sleep(0.004)
        return theta

    simulator = {"blocks": blocks, "rows": SimulatorModel(row, batched=False)}
    expected = quietly(seeded, 5_000).x
    if kind in simulator:
        expected = rows_of(5_000)[0]
    quietly(seeded, 4, workers=2)  # starts what starts workers
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Timer(4.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    num_workers = 2 if kind == "two workers" else 1
    try:
        quietly(simulator.get(kind, slow), 5_000, workers=num_workers)
    except SimulationInterrupted as error:
        rows = error.simulations
        assert int(rows.valid.sum()) >= 150, rows.counts
        assert torch.equal(rows.x[rows.valid], expected[rows.valid])
        assert rows.x[~rows.valid].isnan().all()
        return
    raise AssertionError("not interrupted")


@ATTACKS.add("x of a short run differs from call to call", cases=(3, 500, 5_000))
def repeated(num: int) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        return theta * 0 + len(theta)  # as rounding in a batch of another size may

    for _ in range(3):
        assert (quietly(simulator, num).x == num).all()


@ATTACKS.add("a vectorized simulator is cut", cases=(0.02, 0.2))
def vectorized(seconds: float) -> None:
    calls = []

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        calls.append(len(theta))
        time.sleep(seconds)
        return theta

    require(quietly(simulator, 5_000), rows_of(5_000)[0])
    assert len(calls) <= 6, calls
    calls.clear()
    require(quietly(simulator, 5_000), rows_of(5_000)[0])
    assert len(calls) <= 2, calls


@ATTACKS.add(
    "x depends on the number of workers",
    cases=("seeds", "torch", "numpy", "model", "rows"),
)
def workers_differ(kind: str) -> None:
    def by_torch(theta: Tensor, action: Tensor) -> Tensor:
        return theta + torch.randn_like(theta)

    def by_numpy(theta: Tensor, action: Tensor) -> Any:
        return theta.numpy() + np.random.randn(*theta.shape)

    def row(theta: np.ndarray, action: np.ndarray, rng: Any) -> np.ndarray:
        return theta + rng.normal(size=1)

    simulator = {
        "seeds": seeded,
        "torch": by_torch,
        "numpy": by_numpy,
        "model": SimulatorModel(lambda t, a: t * a, noise=GaussianNoise(1.0)),
        "rows": SimulatorModel(row, batched=False),
    }[kind]
    first = quietly(simulator, 700).x
    for options in (
        {"num_workers": 2},
        {"num_workers": 3, "batch_size": 70},
        {"batch_size": 13},
        {"time_limit": 30.0},
        {"show_progress": True},
    ):
        assert torch.equal(quietly(simulator, 700, **options).x, first), options


@ATTACKS.add("noise is declared of a function that is random", cases=("rows", "batch"))
def noise_twice(kind: str) -> None:
    def row(theta: np.ndarray, action: np.ndarray, rng: Any) -> np.ndarray:
        return theta + rng.normal(size=1)

    def batch(theta: Tensor, action: Tensor) -> Tensor:
        return theta + torch.randn_like(theta)

    function = row if kind == "rows" else batch
    model = SimulatorModel(function, batched=kind == "batch", noise=GaussianNoise(1.0))
    require_raises(ValueError, "noise-free fn", lambda: model.mean(*rows_of(10)))


@ATTACKS.add("the check meets a hostile simulator", cases=("changes", "buffer", "NaN"))
def checked(kind: str) -> None:
    def changes(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = theta + action + row_normals(seeds, 1).float()
        change_torch(theta, action, seeds)
        return x

    buffer = torch.zeros(1_000, 1)

    def fills(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = theta + action + row_normals(seeds, 1).float()
        return buffer[: len(theta)].copy_(x)

    def nothing(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        return theta * torch.nan

    simulator = {"changes": changes, "buffer": fills, "NaN": nothing}[kind]
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    report = check_simulator(simulator, prior, DiscreteActions([1.0, 2.0]), num_rows=64)
    if kind == "NaN":
        assert any("no row has a measurement" in d for d in report.defects)
        return
    assert report.is_ready
    assert report.rows_are_independent
    assert not report.is_deterministic


@ATTACKS.add("a store that forgets, or holds its rows", cases=("all", "half"))
def stored(kind: str) -> None:
    class Store:
        """Gives its own tensors away."""

        def __init__(self, num: int) -> None:
            self.rows = torch.arange(num), torch.zeros(num, 1), torch.zeros(num).char()

        def load(self, run: str) -> Any:
            return self.rows

        def save(self, run: str, **rows: Any) -> None:
            pass

    store = Store(300 if kind == "all" else 150)
    rows = quietly(lambda theta, action, seeds: theta + 1, store=store)
    known = len(store.rows[0])
    assert (rows.x[:known] == 0).all()
    assert torch.equal(rows.x[known:], rows_of(300)[0][known:] + 1)
    rows.x.add_(5)
    assert (store.rows[1] == 0).all(), "the store's rows changed"


@ATTACKS.add("options that make no sense", cases=tuple(range(8)))
def options(case: int) -> None:
    bad: list[dict[str, Any]] = [
        {"num_workers": 0},
        {"num_workers": -2},
        {"batch_size": 0},
        {"batch_size": -1},
        {"time_limit": 0.0},
        {"time_limit": float("nan")},
        {"num_retries": -1},
        {"seed": -1},
    ]
    given = {"seed": 0, **bad[case]}
    rows = rows_of(3)
    require_raises(ValueError, "expected", lambda: simulate(seeded, *rows, **given))


@ATTACKS.add("the simulator of a worker depends on its folder")
def folder(_: str) -> None:
    Path("value").write_text("4")

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        return theta * 0 + float(Path("value").read_text())

    assert (quietly(simulator, 20, workers=2).x == 4).all()
