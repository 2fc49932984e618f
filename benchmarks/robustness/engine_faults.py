"""Attacks by rows that raise, hang or end their process."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.simulations import (
    FEW_WAYS,
    WAYS,
    quietly,
    require,
    require_raises,
    rows_of,
    seeded,
)
from sbi_active import SimulatorModel
from sbi_active.simulation import (
    SimulationError,
    Workers,
)

ATTACKS = Attacks()


class Stop(BaseException):
    """Not an Exception."""


KINDS_RAISED = {
    "RuntimeError": RuntimeError,
    "StopIteration": StopIteration,
    "MemoryError": MemoryError,
    "RecursionError": RecursionError,
    "SystemExit": SystemExit,
    "KeyboardInterrupt": KeyboardInterrupt,
    "GeneratorExit": GeneratorExit,
    "BaseException": Stop,
}


@ATTACKS.add("a row raises in a worker", cases=tuple(KINDS_RAISED))
def raised_in_worker(kind: str) -> None:
    error = KINDS_RAISED[kind]

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        if bool((theta == 11).any()):
            raise error("the reason")
        return seeded(theta, action, seeds)

    rows = quietly(simulator, 100, workers=2)
    require(rows, quietly(seeded, 100).x, missing=(11,))
    assert "the reason" in rows.tracebacks[11]
    assert "in simulator" in rows.tracebacks[11]


@ATTACKS.add("setup raises in a worker", cases=("ValueError", "SystemExit", "Stop"))
def raised_in_setup(kind: str) -> None:
    error = {"ValueError": ValueError, "SystemExit": SystemExit, "Stop": Stop}[kind]

    def setup() -> None:
        raise error("no licence")

    def fn(theta: Tensor, action: Tensor, *, context: Any) -> Tensor:
        return theta

    model = SimulatorModel(fn, setup=setup)
    require_raises(SimulationError, "no licence", lambda: quietly(model, workers=2))


class UnprintableError(Exception):
    """Its text raises, and it cannot be pickled."""

    def __init__(self) -> None:
        self.lock = threading.Lock()

    def __str__(self) -> str:
        raise ValueError("no text")


@ATTACKS.add("an exception without a text", cases=("one call", "two workers"))
def unprintable(way: str) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        if bool((theta == 11).any()):
            raise UnprintableError
        return theta

    require(quietly(simulator, 100, **WAYS[way]), rows_of(100)[0], missing=(11,))


DEATHS: dict[str, Callable[[], Any]] = {
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSEGV": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "SIGTERM": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "exit": lambda: os._exit(3),
    "abort": os.abort,
}


@ATTACKS.add("a row ends its process", cases=tuple(DEATHS))
def death(kind: str) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        if bool((theta == 11).any()):
            DEATHS[kind]()
        return seeded(theta, action, seeds)

    expected = quietly(seeded, 60).x
    require(quietly(simulator, 60, workers=2), expected, missing=(11,))


@ATTACKS.add("a row hangs", cases=(1, 2))
def hanging(num_workers: int) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        if bool((theta == 11).any()):
            time.sleep(600)
        return seeded(theta, action, seeds)

    rows = quietly(
        simulator, 60, workers=Workers(num_workers=num_workers, time_limit=0.3)
    )
    require(rows, quietly(seeded, 60).x, missing=(11,))
    assert "timed out" in rows.tracebacks[11]


@ATTACKS.add("every row raises", cases=(1, 16, 5_000))
def all_raise(num: int) -> None:
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        raise RuntimeError("broken engine")

    for options in ({}, {"num_workers": 2}):
        require_raises(
            SimulationError,
            "broken engine",
            lambda o=options: quietly(simulator, num, **o),
        )


@ATTACKS.add("every second row raises", cases=FEW_WAYS)
def half_raise(way: str) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        if bool((theta % 2 == 1).any()):
            raise RuntimeError("no")
        return seeded(theta, action, seeds)

    odd = tuple(range(1, 100, 2))
    require(quietly(simulator, 100, **WAYS[way]), quietly(seeded, 100).x, missing=odd)


@ATTACKS.add("a simulator prints, warns and seeds the process", cases=FEW_WAYS)
def noisy_process(way: str) -> None:
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        print("hello" * 10_000)
        warnings.warn("careful", stacklevel=1)
        np.random.seed(0)
        return theta + torch.randn_like(theta)

    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    rows = quietly(simulator, **WAYS[way])
    assert torch.equal(torch.rand(3), expected), "the caller's generator moved"
    clean = quietly(lambda theta, action: theta + torch.randn_like(theta))
    require(rows, clean.x)
