"""What an interrupt costs in this process: about a second, and what cutting costs."""

import gc
import signal
import time

import pytest
import torch

from sbi_active import SimulatorModel, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import Outcome, SimulationInterrupted
from sbi_active.simulation.workers.schedule import Pace, pace_of


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
    before = pace_of(model := SimulatorModel(lambda t, a: t))
    assert pace_of(model) is before
    del model
    gc.collect()
    assert pace_of(SimulatorModel(lambda t, a: t)) is not before
