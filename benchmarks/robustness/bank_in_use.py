"""Attacks on the bank in use: misuse, killed writers, full disks, lost Dask workers."""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import joblib
import numpy as np
import torch

from benchmarks.robustness.attacks import Attacks
from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import Simulations, reuse
from sbi_active.simulation.bank import LockedError

ATTACKS = Attacks()

# A worker of a cluster need not have this module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def seeded(theta: torch.Tensor, action: torch.Tensor, seeds: torch.Tensor) -> Any:
    return theta * action + row_normals(seeds, 1).float()


def normal(mean: float = 0.0, sd: float = 1.0) -> torch.distributions.Distribution:
    mean_, sd_ = torch.full((1,), mean), torch.full((1,), sd)
    return torch.distributions.Independent(torch.distributions.Normal(mean_, sd_), 1)


def columns(num_rows: int = 5, dtype: Any = torch.float32) -> Simulations:
    theta = torch.arange(2.0 * num_rows).reshape(num_rows, 2).to(dtype)
    return Simulations(theta, theta[:, :1], theta + 1)


def raises(kind: type[Exception], text: str, act: Callable[[], Any]) -> None:
    try:
        act()
    except kind as error:
        said = str(error)
    else:
        raise AssertionError("accepted without a word")
    assert text in said, said


MISUSE: dict[str, tuple[str, Callable[[Bank], Any]]] = {
    "complex x": (
        "expected x of real",
        lambda b: b.append(
            Simulations(torch.ones(2, 1), torch.ones(2, 1), 1j * torch.ones(2, 1), _ok),
            seed=0,
        ),
    ),
    "x of 1e39": (
        "within +-3.4e38",
        lambda b: b.append(
            Simulations(torch.ones(2, 1), torch.ones(2, 1), _large, _ok), seed=0
        ),
    ),
    "theta of 1e39": (
        "theta within +-3.4e38",
        lambda b: b.append(
            Simulations(_large, torch.ones(2, 1), torch.ones(2, 1)), seed=0
        ),
    ),
    "other shapes": (
        "as in the bank",
        lambda b: b.append(
            Simulations(torch.ones(2, 2), torch.ones(2, 1), torch.ones(2, 7)), seed=3
        ),
    ),
    "a short action": (
        "one an index",
        lambda b: b.append(
            Simulations(torch.ones(2, 2), torch.ones(1, 1), torch.ones(2, 2)), seed=3
        ),
    ),
    "a label alone": (
        "together",
        lambda b: b.append(columns(), seed=3, label="prior"),
    ),
    "an unknown column": ("expected columns among", lambda b: b.columns("thetas")),
    "chunks of 0": ("expected size >= 1", lambda b: [*b.chunks(0)]),
    "position -1": ("expected positions", lambda b: b.read([-1])),
    "position 5": ("expected positions", lambda b: b.read([5])),
    "a float position": ("expected positions", lambda b: b.read([0.5])),  # type: ignore
    "a short mask": ("expected positions", lambda b: b.read(torch.ones(3) > 0)),
    "a reader writes": (
        "opened with its",
        lambda b: Bank(b.path).append(columns(), seed=1),
    ),
}
_large, _ok = torch.full((2, 1), 1e39, dtype=torch.float64), torch.zeros(2)


@ATTACKS.add("the bank is misused", cases=tuple(MISUSE))
def misused(case: str) -> None:
    text, act = MISUSE[case]
    with Bank("bank", simulator=seeded) as bank:
        bank.append(columns(), seed=0)
        raises(ValueError, text, lambda: act(bank))
        assert torch.equal(bank.read().x, columns().x)


@ATTACKS.add(
    "rows of other kinds come back",
    cases=("float64", "float16", "int64", "bool", "strided", "0 rows", "numpy seed"),
)
def kinds(case: str) -> None:
    dtype = {"float64": torch.float64, "float16": torch.float16}.get(case)
    dtype = dtype or {"int64": torch.int64, "bool": torch.bool}.get(case)
    rows = columns(0 if case == "0 rows" else 5, dtype or torch.float32)
    if case == "strided":
        rows = Simulations(rows.theta.flip(0).T.contiguous().T, rows.action, rows.x)
    seed: Any = np.int64(3) if case == "numpy seed" else 3
    with Bank("bank", simulator=seeded) as bank:
        assert bank.append(rows, seed=seed) == len(rows)
        assert bank.append(rows, seed=seed) == 0  # stored once
        if len(rows):
            assert torch.equal(bank.read().theta, rows.theta.float())
            assert torch.equal(bank.read().x, rows.x.float())


@ATTACKS.add("a run is stored in parts", cases=(1, 255, 256, 257, 1000))
def parts(case: int) -> None:
    theta, action = torch.rand(1000, 1), torch.rand(1000, 1)
    expected = simulate(seeded, theta, action, seed=5)
    with Bank("bank", simulator=seeded) as bank:
        digest = _digest(theta, action)
        for start in (0, 500):
            rows = slice(start, start + case)
            index = torch.arange(1000)[rows]
            bank.save(
                digest,
                index=index,
                theta=theta[index],
                action=action[index],
                x=expected.x[index],
                status=expected.status[index],
                seed=5,
            )
        again = simulate(seeded, theta, action, seed=5, store=bank)
        assert torch.equal(again.x, expected.x)
        assert len(bank) == 1000
        assert bank.columns("index")["index"].unique().numel() == 1000


def _digest(theta: torch.Tensor, action: torch.Tensor) -> str:
    from sbi_active.simulation.workers import run_digest

    return run_digest(5, theta, action)


@ATTACKS.add("rows are reused for another target", cases=range(5))
def reused(case: int) -> None:
    torch.manual_seed(case)
    theta = normal().sample((20_000,))
    rows = Simulations(theta, torch.zeros_like(theta), theta)
    with Bank("bank", simulator=seeded) as bank:
        bank.append(rows, seed=case, proposal=normal(), label="prior")
        weighted = reuse(bank, normal(0.5, 0.5), proposals={"prior": normal()})
    mean = float((weighted.weights * theta[:, 0].double()).sum())
    assert abs(mean - 0.5) < 5 * 0.5 / weighted.effective_sample_size**0.5


@ATTACKS.add("a writer is killed", cases=(0.0, 0.05, 0.1, 0.2, 0.4), seconds=300)
def killed(case: float) -> None:
    theta, action = torch.rand(64, 1), torch.rand(64, 1)
    expected = simulate(seeded, theta, action, seed=5)
    child = os.fork()
    if child == 0:
        with Bank("bank", simulator=seeded) as bank:
            for seed in range(1000):
                simulate(seeded, theta, action, seed=seed, store=bank)
        os._exit(0)
    while not Path("bank/store.db").exists():
        time.sleep(0.01)
    time.sleep(case)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with Bank("bank", simulator=seeded) as bank:
        assert bank.verify() == []
        assert len(bank) % 64 == 0
        simulate(seeded, theta, action, seed=5, store=bank)
        mine = bank.columns("x", "seed")
        assert torch.equal(mine["x"][mine["seed"] == 5], expected.x)


@ATTACKS.add("two write at once")
def two_writers(case: str) -> None:
    with Bank("bank", simulator=seeded) as bank:
        bank.append(columns(), seed=0)
        other = Bank("bank", simulator=seeded)

        def write() -> None:
            other.append(columns(), seed=1)

        for content in (b"[]", b"[" * 10**5, b'{"pid": [1]}'):  # whoever wrote that
            with bank._store.writing():
                bank._store.put("objects", "writer", 0, content)
            raises(LockedError, "no other writer", write)
    write()


@ATTACKS.add("the disk is full", cases=(1, 20_000, 60_000))
def full(case: int) -> None:
    with Bank("bank", simulator=seeded) as bank:
        bank.append(columns(), seed=0)
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (case, hard))
        raises(OSError, "make room", lambda: bank.append(columns(20_000), seed=1))
    assert torch.equal(Bank("bank").read().x, columns().x)
    assert Bank("bank").verify() == []


# A cluster that loses its workers -------------------------------------------------


class Slow:
    """Takes 2 ms a row."""

    def __call__(self, theta: Any, action: Any, seeds: torch.Tensor) -> Any:
        time.sleep(2e-3 * len(theta))
        return seeded(theta, action, seeds)


class Deadly:
    """Kills its process at an action of 3."""

    def __call__(self, theta: Any, action: Any, seeds: torch.Tensor) -> Any:
        if bool((action == 3).any()):
            os.kill(os.getpid(), signal.SIGKILL)
        return seeded(theta, action, seeds)


def _on_dask(simulator: Any, *rows: torch.Tensor, start: Any, workers: int = 2) -> Any:
    import distributed

    warnings.simplefilter("ignore")
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(workers, **options) as cluster,
        distributed.Client(cluster) as client,
    ):
        if workers:
            client.wait_for_workers(workers)
        threading.Thread(target=start, args=(cluster, client), daemon=True).start()
        with joblib.parallel_config(backend="dask"):
            return simulate(simulator, *rows, seed=0, workers=2)


@ATTACKS.add("Dask workers are killed", cases=(0.3, 1.0, "one"), seconds=300)
def workers_killed(case: Any) -> None:
    rows = torch.rand(1500, 1), torch.rand(1500, 1)

    def kill(cluster: Any, client: Any) -> None:
        pids = [*client.run(os.getpid).values()]
        time.sleep(0.5 if case == "one" else case)
        for pid in pids[:1] if case == "one" else pids:
            os.kill(pid, signal.SIGKILL)

    result = _on_dask(Slow(), *rows, start=kill)
    assert torch.equal(result.x, simulate(seeded, *rows, seed=0).x)


@ATTACKS.add("rows kill their Dask workers", cases=(1, 3), seconds=300)
def rows_kill(case: int) -> None:
    theta, action = torch.rand(60, 1), torch.rand(60, 1)
    clean = simulate(seeded, theta, action, seed=0).x
    deadly = [5, 20, 40][:case]
    action[deadly] = 3
    result = _on_dask(Deadly(), theta, action, start=lambda *_: None)
    assert sorted(result.tracebacks) == deadly
    assert torch.equal(result.x[result.valid], clean[result.valid])


@ATTACKS.add("Dask workers come late", seconds=200)
def workers_late(case: str) -> None:
    rows = torch.rand(100, 1), torch.rand(100, 1)

    def start(cluster: Any, client: Any) -> None:
        time.sleep(8)
        cluster.scale(1)

    result = _on_dask(Slow(), *rows, start=start, workers=0)
    assert torch.equal(result.x, simulate(seeded, *rows, seed=0).x)
