"""A small bank of four segments, and what damages it."""

import sqlite3
from contextlib import closing

import torch
from torch.distributions import MultivariateNormal

from sbi_active import Bank
from sbi_active.simulation import Simulations
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.workers.store import run_digest

FILE = "store.db"


def simulator(theta, action):
    return theta


def append(bank, rows, seed):
    """Store rows that were simulated elsewhere, and return how many were new."""
    before, columns = len(bank), {**vars(rows)}
    run = run_digest(seed, columns["theta"], columns["action"])
    bank.save(run, seed=seed, index=torch.arange(len(rows)), **columns)
    return len(bank) - before


def filled(path):
    """Return the folder of a bank with four segments of five rows."""
    prior = MultivariateNormal(torch.zeros(2), torch.eye(2))
    with Bank(path, simulator=simulator) as bank:
        for seed in range(4):
            theta = torch.full((5, 2), float(seed))
            rows = Simulations(theta, theta[:, :1], theta)
            append(bank.drawn_from(prior), rows, seed)
    return bank.path


def execute(folder, statement, *values):
    """Change the file as anybody can who has SQLite."""
    with closing(sqlite3.connect(folder / FILE, isolation_level=None)) as connection:
        found = connection.execute(statement, values).fetchall()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return found


def crafted(folder, kind, number, content):
    """Put a record with the right checksum."""
    store = Store(folder)
    with store.writing():
        store.put(kind, content, number)
    store.close()


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << position % 8
    path.write_bytes(content)
