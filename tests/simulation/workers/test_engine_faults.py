"""Rows that raise, hang, kill their process or give no numbers."""

import os
import re
import signal
import sys
import time
import warnings

import cloudpickle
import pytest
import torch

from sbi_active import SimulatorModel, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation import MissingRowsWarning, Outcome, SimulationError, Workers
from sbi_active.simulation.workers.pools import Worker

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def seeded(theta, action, seeds):
    return theta + row_normals(seeds, 1).float()


class Faulty:
    """theta is the row; 5 % raise, 1 % hang, 10 % are NaN, and one ends its process."""

    def __init__(self, killer=None, marker=None):
        self.killer = killer
        self.marker = marker  # a file: the process is killed only until it is there

    def __call__(self, theta, action, seeds):
        x = seeded(theta, action, seeds)
        for i, row in enumerate(theta[:, 0].long().tolist()):
            if row == self.killer and not (self.marker and os.path.exists(self.marker)):
                if self.marker:
                    open(self.marker, "w").close()
                os.kill(os.getpid(), signal.SIGKILL)
            if row % 20 == 3:
                raise RuntimeError(f"row {row} raised")
            if row % 100 == 57:
                time.sleep(60)
            if row % 10 == 5:
                x[i] = torch.nan
        return x


def index_rows(n):
    return torch.arange(float(n))[:, None], torch.zeros(n, 1)


def quietly(*args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingRowsWarning)
        return simulate(*args, **options)


def test_faults_cost_their_rows_alone():
    n, killer = 200, 40
    theta, action = index_rows(n)
    clean = simulate(seeded, theta, action, seed=7).x
    # A second, since other jobs may hold a worker up for tenths of one.
    workers = Workers(2, time_limit=1.0)
    with pytest.warns(MissingRowsWarning) as warned:
        rows = simulate(Faulty(killer), theta, action, seed=7, workers=workers)
    index = torch.arange(n)
    raised, hung = index % 20 == 3, index % 100 == 57
    killed, lost = index == killer, index % 10 == 5
    missing = raised | hung | killed
    assert torch.equal(rows.status == Outcome.MISSING, missing)
    assert torch.equal(rows.status == Outcome.INVALID, lost & ~missing)
    assert torch.equal(rows.x[rows.valid], clean[rows.valid])
    assert rows.x[~rows.valid].isnan().all()
    assert rows.tracebacks.keys() == set(index[missing].tolist())
    assert "row 23 raised" in rows.tracebacks[23]
    assert "in __call__" in rows.tracebacks[23]
    assert rows.tracebacks[57] == "timed out: no answer within 1 s"
    assert "was ended by signal 9" in rows.tracebacks[killer]
    assert len(warned) == 1
    text = str(warned[0].message)
    for count in ("13 of 200 rows are missing", "10 raised", "2 timed out"):
        assert count in text
    assert "1 worker died" in text


def test_infinite_rows_are_invalid_and_partial_ones_are_masked():
    def simulator(theta, action, seeds):
        x = theta.repeat(1, 2)
        x[0] = torch.inf
        x[1, 0] = -torch.inf
        return x

    rows = simulate(simulator, torch.rand(3, 1), torch.rand(3, 1), seed=0)
    assert rows.status.tolist() == [Outcome.INVALID, Outcome.OK, Outcome.OK]
    assert rows.x.isnan().tolist() == [[True, True], [True, False], [False, False]]


@pytest.mark.parametrize("num_workers", [1, 2])
def test_blocks_without_faults_are_what_they_would_have_been(num_workers):
    def simulator(theta, action):
        if (theta == 300).any():
            raise RuntimeError("no")
        return theta + torch.randn_like(theta)

    def clean(theta, action):
        return theta + torch.randn_like(theta)

    theta, action = index_rows(600)
    expected = simulate(clean, theta, action, seed=0).x
    rows = quietly(simulator, theta, action, seed=0, workers=num_workers)
    assert rows.tracebacks.keys() == {300}
    others = torch.cat([torch.arange(256), torch.arange(512, 600)])
    assert torch.equal(rows.x[others], expected[others])
    # Rows of the block that failed have streams of their own.
    again = quietly(simulator, theta, action, seed=0, workers=2, batch_size=1)
    assert torch.equal(rows.x[rows.valid], again.x[again.valid])
    assert rows.valid[256:512].sum() == 255
    assert not torch.equal(rows.x[256:300], expected[256:300])


def test_an_accident_does_not_change_x_of_a_block(tmp_path):
    marker = tmp_path / "died"

    def simulator(theta, action):
        if not marker.exists():
            marker.touch()
            os._exit(3)
        return theta + torch.randn_like(theta)

    rows = index_rows(300)
    x = simulate(simulator, *rows, seed=0, workers=2).x
    assert marker.exists()
    assert torch.equal(x, simulate(simulator, *rows, seed=0).x)


def test_missing_rows_are_tried_again(tmp_path):
    rows = index_rows(3)
    clean = simulate(seeded, *rows, seed=0).x
    simulator = Faulty(1, str(tmp_path / "once"))
    once = quietly(simulator, *rows, seed=0, workers=2, batch_size=1)
    assert once.tracebacks.keys() == {1}
    simulator = Faulty(1, str(tmp_path / "twice"))
    again = Workers(2, num_retries=1)
    twice = simulate(simulator, *rows, seed=0, workers=again, batch_size=1)
    assert twice.tracebacks == {}
    assert torch.equal(twice.x, clean)


@pytest.mark.parametrize("num_workers", [1, 2])
@pytest.mark.parametrize("n", [1, 2_000])
def test_a_simulator_that_always_raises_is_an_error(n, num_workers):
    calls = []

    def simulator(theta, action, seeds):
        calls.append(len(theta))
        raise RuntimeError(f"no engine for {int(theta[0])}")

    text = "(?s)expected a simulator that can simulate.*no engine for"
    with pytest.raises(SimulationError, match=text):
        simulate(simulator, *index_rows(n), seed=0, workers=num_workers)
    assert len(calls) < 100  # the rest of a long run is not tried


def test_a_simulator_that_raises_on_its_first_rows_goes_on():
    def simulator(theta, action, seeds):
        if bool((theta < 60).any()):
            raise RuntimeError("no")
        return seeded(theta, action, seeds)

    theta, action = index_rows(120)
    rows = quietly(simulator, theta, action, seed=0, batch_size=4)
    assert rows.counts == {"ok": 60, "invalid": 0, "missing": 60}
    clean = simulate(seeded, theta, action, seed=0).x
    assert torch.equal(rows.x[60:], clean[60:])


@pytest.mark.parametrize("num_workers", [1, 2])
def test_wrong_shapes_are_no_fault_of_a_row(num_workers):
    theta, action = index_rows(30)
    for simulator in (lambda t, a, seeds: t[:1], lambda t, a: t[:1]):
        with pytest.raises(ValueError, match="with one row a parameter set"):
            simulate(simulator, theta, action, seed=0, workers=num_workers)

    def ragged(theta, action, seeds):
        return torch.zeros(len(theta), 2 if theta[0] > 15 else 1)

    with pytest.raises(ValueError, match="expected x of one shape a row"):
        simulate(ragged, theta, action, seed=0, workers=num_workers, batch_size=10)


def test_a_simulator_that_takes_no_action_is_no_fault_of_a_row():
    with pytest.raises(TypeError, match="positional argument"):
        simulate(lambda theta: theta, *index_rows(30), seed=0)


class Stop(BaseException):
    """What except Exception does not see."""


def raising():
    raise Stop("no licence")


#: What ends a call, and what is told of it.
ENDS = [
    (raising, r"(?s)in simulator.*no licence\s*$"),
    (lambda: os._exit(3), "ended with code 3 during the call"),
]


@pytest.mark.parametrize(("end", "text"), ENDS)
def test_whatever_ends_a_call_in_a_worker_is_told(end, text):
    def simulator(theta, action, seeds):
        if (theta == 1).any():
            end()
        return seeded(theta, action, seeds)

    rows = quietly(simulator, *index_rows(8), seed=0, workers=2)
    assert rows.tracebacks.keys() == {1}
    assert re.search(text, rows.tracebacks[1])
    expected = simulate(seeded, *index_rows(8), seed=0).x
    assert torch.equal(rows.x[rows.valid], expected[rows.valid])


#: What is no setup, and what is said of it.
LOADS = [
    (raising, r"(?s)can load; got.*no licence"),
    (lambda: time.sleep(60), "no answer within 0.5 s"),
]


@pytest.mark.parametrize(("setup", "text"), LOADS)
def test_a_simulator_that_does_not_load_is_an_error_that_says_why(
    setup, text, monkeypatch
):
    def fn(theta, action, *, context):
        return theta

    monkeypatch.setattr(Worker, "LOADING", 0.5)
    model, limited = SimulatorModel(fn, setup=setup), Workers(2, time_limit=0.1)
    with pytest.raises(SimulationError, match=text):
        simulate(model, *index_rows(3), seed=0, workers=limited)
