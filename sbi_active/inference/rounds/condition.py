"""The condition of an action-extended estimator: an outcome with its action appended.

ASBI conditions on (x, action). sbi's trainers know one condition tensor, so x is
flattened and the action appended; :class:`ActionEmbedding` undoes that in front of an
embedding net.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sbi_active.arrays import own_tensor


def pack(x: Tensor, action: Tensor) -> Tensor:
    """Return the condition (x, action), (n, *x_shape) and (n, a) -> (n, x_dim + a)."""
    return torch.cat([x.flatten(1), action], dim=-1)


def action_rows(
    action: Tensor, action_dim: int | None, *, num_rows: int | None = None
) -> Tensor:
    """Return actions as float32 rows of their own, one repeated where one is given.

    Args:
        action: Action, shape (action_dim,), (1, action_dim) or (n, action_dim).
        action_dim: The dimension to expect; None takes that of ``action``.
        num_rows: Rows n to return; None keeps as many as there are.

    Returns:
        Shape (n, action_dim).

    Raises:
        ValueError: If the shape does not fit.
    """
    rows = torch.as_tensor(action, dtype=torch.float32).clone()
    rows = rows.reshape(1, -1) if rows.ndim < 2 else rows
    wrong_dim = rows.ndim != 2 or action_dim not in (None, rows.shape[-1])
    if wrong_dim or (num_rows is not None and len(rows) not in (1, num_rows)):
        expected = ("n" if num_rows is None else num_rows, action_dim or "action_dim")
        raise ValueError(
            f"expected action of shape ({expected[0]}, {expected[1]}) or "
            f"({expected[1]},); got {tuple(torch.as_tensor(action).shape)}; give "
            "the executed action, one row an outcome"
        )
    return rows if num_rows is None else rows.expand(num_rows, -1)


def outcome_rows(x: Tensor, x_shape: Sequence[int], *, copy: bool = True) -> Tensor:
    """Return outcomes as float32 rows of their own, of the shape seen in training.

    Args:
        x: Shape x_shape or (n, *x_shape); a scalar where x is one number.
        x_shape: Shape of one outcome.
        copy: Whether float32 rows are copied as well.

    Returns:
        Shape (n, *x_shape).

    Raises:
        ValueError: If the shape does not fit, or a number is complex or beyond float32.
    """
    shape = torch.Size(x_shape)
    rows = own_tensor(x, torch.float32, copy=copy)
    if rows.shape == shape or (rows.ndim == 0 and shape.numel() == 1):
        return rows.reshape(1, *shape)
    if rows.shape[1:] == shape:
        return rows
    raise ValueError(
        f"expected x of shape {tuple(shape)} or (n, {', '.join(map(str, shape))}), as "
        f"simulated; got {tuple(rows.shape)}; give one outcome, or one a row"
    )


class ActionEmbedding(nn.Module):
    """Embed x with a network of its own and append the action.

    Pass it as the embedding net of any sbi builder: the builder sees the packed
    condition, the network inside sees x in its own shape.

    Args:
        net: Network that maps x of shape (n, *x_shape) to (n, num_features).
        x_shape: Shape of one outcome, for example (1, 32, 32).
        action_dim: Numbers in an action.

    Example:
        >>> from sbi.neural_nets import posterior_nn
        >>> net = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(16, 3))
        >>> embedding = ActionEmbedding(net, x_shape=(4, 4), action_dim=1)
        >>> embedding(torch.zeros(2, 17)).shape
        torch.Size([2, 4])
        >>> build = posterior_nn("mdn", embedding_net=embedding)
    """

    def __init__(self, net: nn.Module, x_shape: Sequence[int], action_dim: int) -> None:
        super().__init__()
        self.net = net
        self.x_shape = torch.Size(x_shape)
        self.action_dim = action_dim

    def forward(self, condition: Tensor) -> Tensor:
        """Return the features of x and the action, shape (n, features + action_dim)."""
        expected = self.x_shape.numel() + self.action_dim
        if condition.shape[-1] != expected:
            raise ValueError(
                f"expected a packed condition of {expected} numbers, x "
                f"{tuple(self.x_shape)} and {self.action_dim} of the action; got "
                f"{condition.shape[-1]}; check x_shape and action_dim"
            )
        x, action = condition.tensor_split([self.x_shape.numel()], 1)
        return torch.cat([self.net(x.reshape(-1, *self.x_shape)), action], dim=-1)
