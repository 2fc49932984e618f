"""What the attacks on the engine share."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_active.seeding import row_normals
from sbi_active.simulation import (
    Workers,
    simulate,
)

WAYS: dict[str, dict[str, Any]] = {
    "one call": {},
    "batches of 1": {"batch_size": 1},
    "batches of 33": {"batch_size": 33},
    "two workers": {"workers": Workers(2)},
    "time limit": {"workers": Workers(time_limit=30.0)},
}
FEW_WAYS = ("one call", "batches of 33", "two workers")


def rows_of(num: int) -> tuple[Tensor, Tensor]:
    """Return theta, the row's number, and actions that are one."""
    return torch.arange(float(num))[:, None], torch.ones(num, 1)


def quietly(simulator: Callable[..., Any], num: int = 300, **options: Any) -> Any:
    """Simulate without the warning about missing rows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return simulate(simulator, *rows_of(num), seed=7, **options)


def require(rows: Any, expected: Tensor, *, missing: tuple[int, ...] = ()) -> None:
    """Raise unless the rows have the x expected, but those that are missing."""
    status = torch.zeros(len(expected), dtype=torch.int8)
    status[list(missing)] = 2
    assert torch.equal(rows.status, status), f"status: {rows.counts}"
    ok = status == 0
    assert torch.equal(rows.x[ok], expected[ok]), "another x"
    assert rows.tracebacks.keys() == set(missing), "tracebacks of other rows"


def require_raises(
    kind: type[BaseException], text: str, run: Callable[[], Any]
) -> None:
    """Raise unless an error of a kind tells what is wrong."""
    answer = None
    try:
        run()
    except kind as error:
        answer = str(error)
    assert answer is not None, "accepted without a word"
    assert text in answer, f"another text: {answer}"


def seeded(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
    """Return a draw, each row of its seed."""
    return theta + row_normals(seeds, 1).float()


def change_torch(theta: Tensor, action: Tensor, seeds: Tensor) -> None:
    """Change all arguments of a simulator in place."""
    theta.mul_(3)
    action.add_(1)
    seeds.zero_()
