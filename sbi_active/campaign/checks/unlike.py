"""Actions unlike those executed, at which a lack of fit can show."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions

MANY = 1_024  # draws of a space without end


def most_unlike(actions: ActionSpace, executed: Tensor) -> ActionSpace:
    r"""Return the permitted actions farthest from all executed ones.

    .. math::
        \arg\max_\xi \min_t \lVert (\xi - \xi_t) / r \rVert

    with r the range of each entry. Actions of most information about d parameters tend
    to repeat about d settings, at which any model of d parameters fits.

    Args:
        actions: The permitted ones.
        executed: Executed actions, shape (t, action_dim), t >= 0.

    References:
        Johnson, Moore & Ylvisaker, J. Stat. Plan. Inference 1990 (maximin distance).

    Example:
        >>> speeds = DiscreteActions([0.0, 1.0, 2.0, 3.0, 4.0])
        >>> most_unlike(speeds, torch.tensor([[0.0], [4.0]])).values
        tensor([[2.]])
    """
    if len(executed) == 0:
        return actions
    values = actions.listed()
    if values is None:
        values = actions.sample((MANY,), seed=0)
    width = values.max(0).values - values.min(0).values
    width = torch.where(width > 0, width, torch.ones_like(width))
    distance = torch.cdist(values / width, executed / width).min(1).values
    best = distance >= distance.max() - 1e-6
    return DiscreteActions(values[best], names=actions.names, units=actions.units)
