"""The shapes in which sbi asks a conditional density."""

from __future__ import annotations

from collections.abc import Callable

from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor


def log_prob_of_batch(
    network: ConditionalDensityEstimator,
    density: Callable[[Tensor, Tensor], Tensor],
    input: Tensor,
    condition: Tensor,
) -> Tensor:
    """Return log densities, shape (sample_dim, batch_dim).

    Args:
        network: Knows the shapes of an input and of a condition.
        density: Log density of inputs (sample_dim, batch_dim, d), given conditions
            (batch_dim, condition_dim).
        input: Inputs, shape (sample_dim, batch_dim, d) or (batch_dim, d).
        condition: Conditions, shape (batch_dim, condition_dim), or with the sample_dim
            too.
    """
    network._check_condition_shape(condition)
    network._check_input_shape(input)
    rows = input[None] if input.ndim == 2 else input
    if condition.ndim == 2:
        return density(rows, condition)
    shape = condition.shape[:2]
    pairs = rows.expand(*shape, -1).reshape(1, -1, rows.shape[-1])
    return density(pairs, condition.flatten(0, 1)).reshape(shape)
