"""A real Dask cluster on this machine, whose workers are killed meanwhile."""

import os
import signal
import sys
import threading
import time
import warnings
from collections import Counter

import cloudpickle
import joblib
import pytest
import torch

from sbi_active import simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import MissingRowsWarning
from sbi_active.simulation.workers.pools import DaskPool
from sbi_active.simulation.workers.settings import Workers

dask = pytest.importorskip("dask")
distributed = pytest.importorskip(
    "distributed", reason="needs Dask: pip install 'sbi-active[cluster]'"
)

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def client():
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client
        for nanny in cluster.workers.values():  # who would ask it to end, and wait
            nanny.auto_restart = False
            os.kill(nanny.pid, signal.SIGKILL)


@pytest.fixture
def rows():
    return torch.rand(600, 1), torch.rand(600, 1)


def seeded(theta, action, seeds):
    return theta * action + row_normals(seeds, 1).float()


class Reporting:
    """Takes its time, and leaves the number of its process for each call."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, theta, action, seeds):
        (self.folder / f"{os.getpid()}-{time.monotonic()}").touch()
        time.sleep(2e-3 * len(theta))
        return seeded(theta, action, seeds)


@pytest.mark.parametrize("all_at_once", [False, pytest.param(True, marks=SLOW)])
def test_workers_killed_in_the_middle_lose_nothing(client, rows, tmp_path, all_at_once):
    client.wait_for_workers(2)
    expected = simulate(seeded, *rows, seed=0).x
    killed = []

    def kill():
        """Kill the first process that is at its third call, or all of them."""
        while not killed:
            calls = Counter(int(f.name.split("-")[0]) for f in tmp_path.iterdir())
            killed.extend([pid for pid, count in calls.items() if count >= 3][:1])
            time.sleep(1e-3)
        if all_at_once:
            killed[:] = client.run(os.getpid).values()
        for pid in killed:
            os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    with joblib.parallel_config(backend="dask"):
        result = simulate(Reporting(tmp_path), *rows, seed=0, workers=2, batch_size=10)
    killer.join(timeout=0)
    assert not killer.is_alive()  # they were killed before the end
    assert result.tracebacks == {}
    assert torch.equal(result.x, expected)
    assert not {*killed} & {*client.run(os.getpid).values()}


def test_a_row_that_hangs_costs_itself_on_a_cluster(client, rows):
    def simulator(theta, action, seeds):
        if bool((action == 3).any()):
            time.sleep(60)
        return seeded(theta, action, seeds)

    theta, action = (r[:8].clone() for r in rows)
    action[5] = 3
    limited = Workers(2, time_limit=1.0)
    with (
        joblib.parallel_config(backend="dask"),
        pytest.warns(MissingRowsWarning, match="1 of 8 rows are missing: 1 timed out"),
    ):
        result = simulate(simulator, theta, action, seed=0, workers=limited)
    clean = simulate(seeded, theta, action, seed=0).x
    assert result.tracebacks.keys() == {5}
    assert torch.equal(result.x[result.valid], clean[result.valid])


@SLOW
def test_a_row_that_kills_every_worker_loses_no_good_row(client, rows):
    def killer(theta, action, seeds):
        if bool((action == 3).any()):
            os.kill(os.getpid(), signal.SIGKILL)
        return theta

    theta, action = (r[:4] for r in rows)
    action[2] = 3
    with joblib.parallel_config(backend="dask"), warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingRowsWarning)
        result = simulate(killer, theta, action, seed=0, workers=2, batch_size=2)
    assert result.tracebacks.keys() == {2}
    assert "ended by signal 9" in result.tracebacks[2]
    assert torch.equal(result.x[result.valid], theta[result.valid])


def test_workers_that_the_cluster_gave_up_are_asked_for_again(rows, monkeypatch):
    monkeypatch.setattr(DaskPool, "PATIENCE", 0.5)
    theta, action = (r[:20] for r in rows)
    results = []

    def run():
        with joblib.parallel_config(backend="dask"):
            results.append(simulate(seeded, theta, action, seed=0, workers=2))

    async def give_up(cluster):  # as it does where one is not back after 15 s
        for name in [*cluster.workers]:
            await cluster.workers.pop(name).close()

    own = {"n_workers": 1, "processes": False, "dashboard_address": None}
    with (
        distributed.LocalCluster(**own) as cluster,
        distributed.Client(cluster) as client,
        warnings.catch_warnings(record=True) as said,
    ):
        warnings.simplefilter("always")
        client.sync(give_up, cluster)
        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        thread.join(timeout=30)
        assert not thread.is_alive()
    texts = [str(warning.message) for warning in said]
    assert any("no workers at inproc://" in text for text in texts)
    assert torch.equal(results[0].x, simulate(seeded, theta, action, seed=0).x)
