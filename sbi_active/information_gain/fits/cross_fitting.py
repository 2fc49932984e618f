"""Score held-out rows, and choose a member on rows that are not scored with it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

NUM_FOLDS = 4  # a choice: fits of three quarters of the rows, four times


def cross_fit(
    score: Callable[[Tensor, Tensor], Tensor], block: Tensor, weight: Tensor
) -> Tensor:
    """Return scores of every row (n,) by members fitted and chosen without it.

    Args:
        score: ``score(train, test)``, both of rows, gives the scores of the test rows
            by each member fitted to the training rows, shape (members, test).
        block: Number of the block that a row belongs to, shape (n,): rows of a block
            share a fold, which the member scores that is the best on the others.
        weight: Weight of each row in the choice, shape (n,).
    """
    fold = block % NUM_FOLDS
    held_out: Tensor | None = None
    for k in range(NUM_FOLDS):
        train, test = torch.nonzero(fold != k)[:, 0], torch.nonzero(fold == k)[:, 0]
        if len(test) == 0:
            continue
        scores = score(train, test)
        if held_out is None:
            held_out = torch.zeros(len(scores), len(block), dtype=torch.float64)
        held_out[:, test] = scores
    assert held_out is not None
    result = torch.empty(len(block), dtype=torch.float64)
    for k in range(NUM_FOLDS):
        others = (held_out * weight)[:, fold != k].sum(1)
        result[fold == k] = held_out[int(others.argmax()), fold == k]
    return result


def patterns_of_numbers(
    x: Tensor, counted: Tensor, smallest: int
) -> list[tuple[Tensor, Tensor]]:
    """Group counted outcomes (n, q) by which of their numbers are present.

    Returns rows, shape (k,), and the numbers present, shape (p,), of each group;
    patterns of fewer rows than the smallest join those without a number.
    """
    rows = torch.nonzero(counted)[:, 0]
    present = x[rows].isfinite()
    patterns, label = torch.unique(present, dim=0, return_inverse=True)
    groups, rest = [], []
    for k, pattern in enumerate(patterns):
        members = rows[label == k]
        columns = torch.nonzero(pattern)[:, 0]
        if len(columns) and len(members) >= smallest:
            groups.append((members, columns))
        else:
            rest.append(members)
    if rest:
        groups.append((torch.cat(rest).sort().values, torch.empty(0).long()))
    return groups
