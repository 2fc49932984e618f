"""Banks to attack, and what it means to survive."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from sbi_active import Bank
from sbi_active.simulation import Simulations
from sbi_active.simulation.bank import CorruptSegmentError

FILE = "store.db"


def simulator(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return theta


def prior() -> torch.distributions.MultivariateNormal:
    return torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))


def rows_of(seed: int, num_rows: int = 5) -> Simulations:
    theta = torch.full((num_rows, 2), float(seed))
    return Simulations(theta, theta[:, :1], theta)


def filled(name: str = "bank", seeds: Any = range(4)) -> Path:
    with Bank(name, simulator=simulator) as bank:
        for seed in seeds:
            bank.append(rows_of(seed), seed=seed, proposal=prior(), label="prior")
    return Path(name)


def execute(folder: Path, statement: str, *values: Any) -> None:
    """Change the file as anybody can who has SQLite."""
    with closing(sqlite3.connect(folder / FILE, isolation_level=None)) as connection:
        connection.execute(statement, values)
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def refused(act: Callable[[], Any], named: Path) -> None:
    """Raise unless the one error comes, which names a file or its folder."""
    try:
        act()
    except CorruptSegmentError as error:
        said = str(error)
    else:
        raise AssertionError("read without a word")
    assert str(named) in said, said


def same_or_refused(folder: Path, expected: Simulations) -> None:
    try:
        rows = Bank(folder).read()
    except CorruptSegmentError:
        return
    except ValueError as error:  # a flipped digit is another format
        if "expected a bank of format 2" not in str(error):
            raise
        return
    assert torch.equal(rows.x, expected.x)
    assert torch.equal(rows.theta, expected.theta)
