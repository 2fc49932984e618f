"""Run a simulator over rows so that x depends on nothing but its seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.simulation.model import (
    SimulatorModel,
    outcome_tensor,
    require_noise,
    takes_seeds,
)
from sbi_active.simulation.outcomes import Simulations

__all__ = ["simulate"]

#: Rows that share one seed of the global generators. Part of the definition of x for a
#: simulator that takes no seeds, so it is never a setting.
BLOCK = 256


def simulate(
    simulator: Callable[..., Any],
    theta: Tensor,
    action: Tensor,
    *,
    seed: int,
    check_noise: bool = False,
) -> Simulations:
    r"""Draw :math:`x_i \sim p(x | \theta_i, \xi_i)`.

    A simulator that takes ``seeds`` gets one a row. Any other runs in fixed blocks of
    256 rows under forked generators of torch and NumPy, which are restored.

    Args:
        simulator: ``simulator(theta, action)``, see
            :class:`~sbi_active.simulation.Simulator`.
        theta: Parameters, shape (n, theta_dim).
        action: Actions, shape (n, action_dim).
        seed: Seed of the whole set.
        check_noise: Simulate the first rows under a second seed and raise where
            nothing differs.

    Returns:
        The simulations, x in float32.

    Raises:
        ValueError: If the shapes do not fit, or the simulator is deterministic and
            ``check_noise`` is set.

    Example:
        >>> rows = simulate(
        ...     lambda theta, action: theta * action + torch.randn_like(theta),
        ...     torch.ones(3, 1), torch.ones(3, 1), seed=0,
        ... )
        >>> rows.x.shape
        torch.Size([3, 1])
    """
    if theta.ndim != 2 or action.ndim != 2 or len(theta) != len(action):
        raise ValueError(
            "expected theta (n, theta_dim) and action (n, action_dim) with as many "
            f"rows; got {tuple(theta.shape)} and {tuple(action.shape)}; do repeat the "
            "action for each row"
        )
    theta, action = theta.float(), action.float()
    x = _run(simulator, theta, action, seed)
    if check_noise:
        few = min(len(theta), 16)
        other = _run(simulator, theta[:few], action[:few], derive_seed(seed, "again"))
        require_noise(x[:few], other)
    return Simulations(theta, action, x)


def _run(
    simulator: Callable[..., Any], theta: Tensor, action: Tensor, seed: int
) -> Tensor:
    seeds = row_seeds(seed, len(theta))
    if takes_seeds(simulator):
        x = simulator(theta, action, seeds=seeds)
        return outcome_tensor(x, len(theta)).float()
    blocks = []
    for start in range(0, len(theta), BLOCK):
        rows = slice(start, start + BLOCK)
        with forked_generators(seed, "block", start):
            if isinstance(simulator, SimulatorModel):
                x = simulator(theta[rows], action[rows], seeds=seeds[rows])
            else:
                x = simulator(theta[rows], action[rows])
        blocks.append(outcome_tensor(x, len(theta[rows])).float())
    return torch.cat(blocks)
