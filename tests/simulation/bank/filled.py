"""A small bank of four segments, and what damages it."""

import sqlite3
from contextlib import closing

import torch

from sbi_active import Bank
from sbi_active.simulation import Simulations
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.workers.store import run_digest

FILE = "store.db"


def simulator(theta, action):
    return theta


def prior():
    return torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))


def append(bank, rows, seed):
    """Store rows that were simulated elsewhere, and return how many were new."""
    before, columns = len(bank), {**vars(rows)}
    run = run_digest(seed, columns["theta"], columns["action"])
    bank.save(run, seed=seed, index=torch.arange(len(rows)), **columns)
    return len(bank) - before


def fill(bank, seeds=(0, 1, 2, 3), num=5):
    for seed in seeds:
        theta = torch.full((num, 2), float(seed))
        rows = Simulations(theta, theta[:, :1], theta)
        append(bank.drawn_from(prior()), rows, seed)


def filled(path):
    """Return the folder of a bank with four segments of five rows."""
    with Bank(path, simulator=simulator) as bank:
        fill(bank)
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


def remove(folder, number):
    execute(folder, "DELETE FROM records WHERE kind = 'rows' AND number = ?", number)


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << position % 8
    path.write_bytes(content)
