"""Kills processes that simulate into a bank, and says what was left of it.

Run as ``killed_writer.py FOLDER NUM_MOMENTS SEED NUM_WORKERS``; one line of JSON a
moment, each in its part of the rows that a process reports, and anywhere in a batch.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import torch

from sbi_active import Bank, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation.workers.store import Recorder

#: An outcome of 80 kB, so that writing takes most of the time.
ROWS, BATCH, NUMBERS = 480, 16, 20_000


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
    return simulate(
        simulator,
        theta,
        action,
        seed=7,
        workers=num_workers,
        batch_size=BATCH,
        store=store,
    )


def kill_after(num_rows, seconds, path, num_workers):
    """Return what a process had reported as stored when it was killed.

    It is killed some seconds after it reported more than a number of rows, so that a
    loaded machine changes when that is, and not how far the process is.
    """
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        bank = Bank(path, simulator=simulator)
        run(Reporting(bank, write), num_workers)
        os._exit(0)
    os.close(write)
    reported, killed = [], False
    with os.fdopen(read) as pipe:
        while True:
            if not killed and sum(len(index) for _, index in reported) > num_rows:
                time.sleep(seconds)
                os.kill(child, signal.SIGKILL)
                killed = True
            line = pipe.readline()
            if not line.endswith("\n"):  # cut, or none is left
                break
            reported.append(json.loads(line))
    return reported, os.WIFSIGNALED(os.waitpid(child, 0)[1])


def main(folder, num_moments, seed, num_workers):
    torch.set_num_threads(1)
    Recorder.INTERVAL = 0.0  # a segment a batch: more writing than simulating
    expected = run()
    start = time.perf_counter()
    with Bank(folder / "whole", simulator=simulator) as bank:
        run(bank)
    duration = time.perf_counter() - start
    moments = random.Random(seed)
    for moment in range(num_moments):
        path = folder / str(moment)
        share = (moment + moments.random()) / num_moments
        num_rows = share * (ROWS + 2 * BATCH) - 2 * BATCH
        if num_workers > 1:  # they take their time to start, and are let report first
            num_rows = max(num_rows, 0)
        seconds = moments.uniform(0, 2 * BATCH / ROWS * duration)
        reported, was_killed = kill_after(num_rows, seconds, path, num_workers)
        log = path / "store.db-wal"
        record = {
            "killed": was_killed,
            "reported": sum(len(index) for _, index in reported),
            "bytes_in_log": log.stat().st_size if log.exists() else 0,
        }
        with Bank(path, simulator=simulator) as bank:
            record["problems"] = bank.verify()
            stored = bank.load(reported[0][0]) if reported else None
            index = torch.tensor([i for _, part in reported for i in part])
            if stored is not None:
                where = {int(i): k for k, i in enumerate(stored[0])}
                record["lost"] = sum(int(i) not in where for i in index)
                record["same"] = torch.equal(stored[1], expected.x[stored[0]])
            record["resumed"] = torch.equal(run(bank).x, expected.x)
            record["rows"] = len(bank)
            record["problems"] += bank.verify()
        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
