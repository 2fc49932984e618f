"""Processes that simulate into a bank are killed, and lose nothing they reported."""

import json
import os
import random
import signal
import time
from multiprocessing import get_context

import pytest
import torch

from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation.workers.store import Recorder

#: An outcome of 80 kB, so that writing takes most of the time.
ROWS, BATCH, NUMBERS = 240, 8, 20_000


def simulator(theta, action, seeds):
    return (theta[:, :1] * action + row_normals(seeds, 1).float()).expand(-1, NUMBERS)


class Reporting:
    """Says which rows are stored, once the bank says so."""

    def __init__(self, bank, pipe):
        self.bank, self.pipe = bank, pipe

    def load(self, run):
        return self.bank.load(run)

    def save(self, run, *, index, **rows):
        self.bank.save(run, index=index, **rows)
        os.write(self.pipe, (json.dumps([run, index.tolist()]) + "\n").encode())


def run(store=None, num_workers=1):
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(ROWS, 2, generator=generator)
    action = torch.rand(ROWS, 1, generator=generator)
    own = {"workers": num_workers, "batch_size": BATCH, "store": store}
    return simulate(simulator, theta, action, seed=7, **own)


def kill_after(num_rows, seconds, path, num_workers):
    """Return what a process had reported as stored when it was killed.

    It is killed some seconds after it reported more than a number of rows, so that a
    loaded machine changes when that is, and not how far the process is.
    """
    read, write = os.pipe()

    def work():
        os.close(read)
        run(Reporting(Bank(path, simulator=simulator), write), num_workers)

    child = get_context("fork").Process(target=work)
    child.start()
    os.close(write)
    reported, killed = [], False
    with os.fdopen(read) as pipe:
        while True:
            if not killed and sum(len(index) for _, index in reported) > num_rows:
                time.sleep(seconds)
                child.kill()
                killed = True
            line = pipe.readline()
            if not line.endswith("\n"):  # cut, or none is left
                break
            reported.append(json.loads(line))
    child.join()
    return reported, child.exitcode == -signal.SIGKILL


#: Moments, a seed, and workers.
KILLS = [
    (3, 0, 1),
    pytest.param(10, 1, 1, marks=pytest.mark.slow),
    pytest.param(4, 2, 2, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("num_moments", "seed", "num_workers"), KILLS)
def test_sigkill_loses_nothing_that_was_reported(
    num_moments, seed, num_workers, tmp_path, monkeypatch, capfd
):
    # A segment a batch: more writing than simulating.
    monkeypatch.setattr(Recorder, "INTERVAL", 0.0)
    expected = run().x
    start = time.perf_counter()
    with Bank(tmp_path / "whole", simulator=simulator) as bank:
        run(bank)
    duration = time.perf_counter() - start
    moments, found = random.Random(seed), []
    for moment in range(num_moments):
        path = tmp_path / str(moment)
        share = (moment + moments.random()) / num_moments
        num_rows = share * (ROWS + 2 * BATCH) - 2 * BATCH
        if num_workers > 1:  # they take their time to start, and are let report first
            num_rows = max(num_rows, 0)
        seconds = moments.uniform(0, 2 * BATCH / ROWS * duration)
        reported, was_killed = kill_after(num_rows, seconds, path, num_workers)
        index = [i for _, part in reported for i in part]
        found.append((was_killed, len(index)))
        with Bank(path, simulator=simulator) as bank:
            bank.verify()
            if reported:
                places, x = bank.load(reported[0][0])[:2]
                assert {*index} <= {*places.tolist()}
                assert torch.equal(x, expected[places])
            assert reported or num_workers == 1
            assert torch.equal(run(bank).x, expected)
            assert len(bank) == ROWS
            bank.verify()
    # Some moments come before the last row, some after the first.
    assert any(was_killed for was_killed, _ in found)
    assert any(0 < num < ROWS for _, num in found)
    assert capfd.readouterr().err == ""  # workers end silently
