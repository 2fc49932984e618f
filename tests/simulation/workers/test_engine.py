"""Seeds, workers, batches, stores and interruptions of the engine."""

import os
import signal
import sys
import threading
import time

import cloudpickle
import numpy as np
import pytest
import torch

from sbi_active import SimulatorModel, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import Outcome, SimulationInterrupted, Workers
from sbi_active.simulation.workers.schedule import Pace, pace_of
from sbi_active.simulation.workers.store import run_digest

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def global_torch(theta, action):
    return theta * action + torch.randn_like(theta)


def global_numpy(theta, action):
    return theta.numpy() * action.numpy() + np.random.randn(*theta.shape)


def seeded(theta, action, seeds):
    return theta * action + row_normals(seeds, 1).float()


def product(theta, action):
    return theta * action


SIMULATORS = [
    global_torch,
    global_numpy,
    seeded,
    SimulatorModel(product, noise=1.0),
    SimulatorModel(global_torch, noise=1.0),
]


class MemoryStore:
    """A store that counts, and refuses rows it has."""

    def __init__(self):
        self.rows = {}
        self.num_saves = 0

    def load(self, run):
        rows = self.rows.get(run)
        if not rows:
            return None
        index = torch.tensor([*rows])  # in the order in which they were finished
        x = torch.stack([rows[int(i)][0] for i in index])
        return index, x, torch.tensor([rows[int(i)][1] for i in index])

    def save(self, run, *, index, theta, action, x, status, seed):
        self.num_saves += 1
        rows = self.rows.setdefault(run, {})
        assert not rows.keys() & set(index.tolist())
        assert len(index) == len(theta) == len(action) == len(x) == len(status)
        finished = zip(x, status.tolist(), strict=True)
        rows.update(zip(index.tolist(), finished, strict=True))


@pytest.fixture(scope="module")
def rows():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(700, 1, generator=generator), torch.ones(700, 1)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_x_depends_on_neither_workers_nor_batches(simulator, rows):
    expected = simulate(simulator, *rows, seed=3).x
    assert expected.isfinite().all()
    for options in ({"batch_size": 1}, {"batch_size": 300}, {"workers": 2}):
        x = simulate(simulator, *rows, seed=3, **options).x
        assert torch.equal(x, expected), options
    assert not torch.equal(simulate(simulator, *rows, seed=4).x, expected)
    fewer = simulate(simulator, *(r[:256] for r in rows), seed=3).x
    assert torch.equal(fewer, expected[:256])
    assert fewer.dtype == torch.float32


def test_workers_use_one_thread_and_the_folder_of_the_caller(tmp_path, monkeypatch):
    def simulator(theta, action, seeds):
        same = os.getcwd() == os.environ["EXPECTED_FOLDER"]
        number = torch.get_num_threads() + (0 if same else 100)
        return torch.full((len(theta), 1), float(number))

    simulate(seeded, torch.rand(2, 1), torch.rand(2, 1), seed=0, workers=2)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EXPECTED_FOLDER", str(tmp_path))
    theta = torch.rand(2, 1)
    assert (simulate(simulator, theta, theta, seed=0, workers=2).x == 1).all()


def test_setup_is_no_part_of_the_time_limit():
    def slow_setup():
        time.sleep(0.5)
        return 2.0

    def fn(theta, action, *, context):
        return theta * context

    model = SimulatorModel(fn, setup=slow_setup, noise=0.0)
    theta = torch.rand(3, 1)
    x = simulate(model, theta, theta, seed=0, workers=Workers(time_limit=0.1)).x
    assert torch.equal(x, theta * 2)


def test_a_store_is_read_before_anything_is_simulated(rows):
    for simulator in (seeded, global_torch):
        expected = simulate(simulator, *rows, seed=3).x
        store = MemoryStore()
        first = simulate(simulator, *rows, seed=3, store=store)
        assert torch.equal(first.x, expected)

        def never(theta, action, seeds):
            raise AssertionError("the rows are stored")

        again = simulate(never, *rows, seed=3, store=store)
        assert torch.equal(again.x, expected)
        assert torch.equal(again.status, first.status)

        # They come in any order, as several workers finish them.
        run = run_digest(3, *rows)
        store.rows[run] = dict(reversed(store.rows[run].items()))
        again = simulate(never, *rows, seed=3, store=store)
        assert torch.equal(again.x, expected)

        # Any part of them may be lacking.
        for row in (0, 5, 256, 300, 301, 699):
            del store.rows[run][row]
        some = simulate(simulator, *rows, seed=3, store=store)
        assert torch.equal(some.x, expected)
        assert len(store.rows[run]) == 700


def test_an_interrupted_simulation_keeps_what_is_finished(rows):
    calls = []

    def simulator(theta, action, seeds):
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(len(theta))
        return seeded(theta, action, seeds)

    store = MemoryStore()
    with pytest.raises(SimulationInterrupted, match="300 ok, 0 invalid, 400") as caught:
        simulate(simulator, *rows, seed=3, batch_size=100, store=store)
    expected = simulate(seeded, *rows, seed=3).x
    kept = caught.value.simulations
    assert torch.equal(kept.x[:300], expected[:300])
    assert kept.x[300:].isnan().all()
    assert (kept.status[300:] == Outcome.MISSING).all()
    assert len(store.rows[run_digest(3, *rows)]) == 300
    resumed = simulate(seeded, *rows, seed=3, store=store)
    assert torch.equal(resumed.x, expected)


def test_an_interrupt_ends_the_workers(rows):
    def simulator(theta, action, seeds):
        time.sleep(0.02 if theta[0] < 0.9 else 30)
        return seeded(theta, action, seeds)

    process = os.getpid()
    threading.Timer(1.0, os.kill, (process, signal.SIGINT)).start()
    start = time.monotonic()
    with pytest.raises(SimulationInterrupted) as caught:
        simulate(simulator, *rows, seed=3, workers=2, batch_size=1)
    assert time.monotonic() - start < 10
    kept = caught.value.simulations
    assert kept.valid.any()
    expected = simulate(seeded, *rows, seed=3).x
    assert torch.equal(kept.x[kept.valid], expected[kept.valid])


def test_a_simulator_must_travel():
    lock = threading.Lock()

    def simulator(theta, action, seeds):
        with lock:
            return seeded(theta, action, seeds)

    theta = torch.rand(3, 1)
    with pytest.raises(TypeError, match="expected a simulator that can travel"):
        simulate(simulator, theta, theta, seed=0, workers=2)


# What an interrupt costs in this process: about a second, and what cutting costs


def made(kind, spend=lambda num: None):
    """Return a simulator of a kind that spends time on each call's rows."""

    def seeded(theta, action, seeds):
        spend(len(theta))
        return theta + row_normals(seeds, 1).float()

    def blocks(theta, action):
        spend(len(theta))
        return theta + torch.randn_like(theta)

    def row(theta, action, rng):
        spend(1)
        return theta + rng.normal(size=1)

    if kind == "row":
        return SimulatorModel(row, batched=False)
    return {"seeded": seeded, "blocks": blocks}[kind]


@pytest.mark.parametrize("kind", ["seeded", "blocks", "row"])
def test_an_interrupt_in_the_default_setting_keeps_finished_rows(kind):
    begun = []

    def spend(num):
        begun.append(num)
        if sum(begun) > 1_000:  # after a second of 20
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.001 * num)

    theta = torch.rand(20_000, 1, generator=torch.Generator().manual_seed(0))
    with pytest.raises(SimulationInterrupted) as raised:
        simulate(made(kind, spend), theta, torch.zeros_like(theta), seed=3)
    rows = raised.value.simulations
    finished = rows.status == Outcome.OK
    assert sum(begun) - finished.sum() < 1_600  # of some 1,000 a second
    assert finished.sum() > 200
    assert (rows.status[~finished] == Outcome.MISSING).all()
    assert rows.x[~finished].isnan().all()
    assert torch.equal(rows.theta, theta)
    expected = simulate(made(kind), theta, torch.zeros_like(theta), seed=3).x
    assert torch.equal(rows.x[finished], expected[finished])


def sizes_of(seconds, num_rows, pace):
    """Return the rows of calls that take as long as a function of their rows says."""
    sizes = []
    while num_rows:
        sizes.append(pace.size(num_rows))
        pace.observe(sizes[-1], seconds(sizes[-1], len(sizes) - 1))
        num_rows -= sizes[-1]
    return sizes


#: Seconds of a call by its rows and its place, rows, the most a call has, and calls.
PACES = {
    "slow rows": (lambda n, call: 0.01 * n, 2_000, 150, 25),
    "a second a row": (lambda n, call: 1.0 * n, 30, 4, 30),
    "a slow first call": (lambda n, call: 0.01 * n + 3 * (call == 0), 2_000, 150, 30),
    "as slow for few": (lambda n, call: 0.05 + 1e-7 * n, 5_000, 5_000, 5),
    "as slow for few, dear": (lambda n, call: 3.0 + 1e-7 * n, 5_000, 5_000, 5),
}


@pytest.mark.parametrize("case", PACES)
def test_calls_take_about_a_second(case):
    seconds, num_rows, most, num_calls = PACES[case]
    pace = Pace()
    sizes = sizes_of(seconds, num_rows, pace)
    assert max(sizes) <= most
    assert len(sizes) <= num_calls
    if most == num_rows:  # known by now
        assert sizes_of(seconds, num_rows, pace) == [num_rows]


def test_a_simulator_is_timed_once(monkeypatch):
    monkeypatch.setattr(Pace, "SECONDS", 60.0)  # whatever else the machine does
    sizes = []

    def simulator(theta, action, seeds):
        sizes.append(len(theta))
        return theta

    theta = torch.rand(700, 1)
    for n in (700, 700, 3, 700):
        simulate(simulator, theta[:n], theta[:n], seed=0)
    assert sizes == [2, 700, 700, 3, 700]


def test_x_is_that_of_one_call_where_that_is_short():
    def simulator(theta, action, seeds):  # whose rows are not independent
        return theta + len(theta)

    theta = torch.rand(500, 1)
    for _ in range(2):
        rows = simulate(simulator, theta, theta, seed=0)
        assert torch.equal(rows.x, theta + 500)
        assert rows.counts == {"ok": 500, "invalid": 0, "missing": 0}


class Robot:
    """Equal to all of its kind, which so have no hash."""

    def __eq__(self, other):
        return isinstance(other, Robot)

    def run(self, theta, action):
        return theta

    def __call__(self, theta, action):
        return theta


class Arm:
    def run(self, theta, action):
        return theta


def test_the_pace_is_known_by_the_simulator():
    arm = Arm()
    assert pace_of(arm.run) is pace_of(arm.run)
    assert pace_of(arm.run) is not pace_of(Arm().run)
    assert pace_of(Robot()) is not pace_of(Robot())
    assert isinstance(pace_of(Robot().run), Pace)
    assert isinstance(pace_of(torch.add), Pace)
