"""Groups of neighboring points of about equal size."""

from __future__ import annotations

import torch
from torch import Tensor

FEWEST = 8  # points of a cell


def cells(point: Tensor, num: int, *, num_continuous: int) -> list[Tensor]:
    """Halve groups of points across their widest side until they are small enough.

    About ``num`` cells of points (n, dim), whose first entries are in a unit cube and
    are halved by; points of a cell agree in the others.

    Example:
        >>> point = torch.tensor([[0.0], [1.0], [0.25], [0.75]] * 8)
        >>> [point[c, 0].unique().tolist() for c in cells(point, 2, num_continuous=1)]
        [[0.0, 0.25], [0.75, 1.0]]
    """
    largest = max(-(-len(point) // num), FEWEST)
    constant = torch.zeros(len(point), 1, dtype=point.dtype)
    category = torch.cat([constant, point[:, num_continuous:]], 1)
    _, label = category.unique(dim=0, return_inverse=True)
    groups = [torch.nonzero(label == k)[:, 0] for k in range(int(label.max()) + 1)]
    done: list[Tensor] = []
    while groups:
        group = groups.pop()
        inside = point[group, :num_continuous]
        if len(group) <= max(largest, 2 * FEWEST - 1) or not inside.numel():
            done.append(group.sort().values)
            continue
        side = int((inside.amax(0) - inside.amin(0)).argmax())
        order = inside[:, side].argsort(stable=True)
        groups += [group[half] for half in order.tensor_split(2)][::-1]
    return [group for group in done if len(group) > 1]
