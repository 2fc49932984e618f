"""Exact greedy design of the numerical model: the limit a myopic method can reach."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sbi_active.tasks.numerical.exact import (
    ExactPosterior,
    as_actions,
    as_array,
    as_parameters,
    noise_free,
)

__all__ = ["GreedyDesign", "greedy_action", "greedy_design", "reproduction_error"]

REPRODUCTION_ACTIONS = (-3.0, 0.0, 3.0)  # where the paper compares outcomes


class GreedyDesign(NamedTuple):
    """An exact greedy campaign of r rounds.

    Attributes:
        action: Chosen actions, shape (r, 1).
        x: Observations, shape (r, 1).
        gain: Expected information gain of the chosen actions in nats, shape (r,).
        log_prob: Log posterior density of the truth after each round, shape (r,).
        reproduction_error: After each round, at -3, 0 and 3, shape (r, 3).
    """

    action: Tensor
    x: Tensor
    gain: Tensor
    log_prob: Tensor
    reproduction_error: Tensor


def greedy_action(
    posterior: ExactPosterior,
    actions: Tensor | ArrayLike,
    *,
    seed: int | np.random.Generator | None = None,
) -> tuple[int, Tensor]:
    """Index of the most informative action, and the gain of every action.

    Args:
        posterior: The belief under which the gain is expected.
        actions: Candidates, shape (a,) or (a, 1).
        seed: Seed or generator that chooses among actions within 1e-6 nat of the best.

    Returns:
        Index into actions, and gains in nats, shape (a,).
    """
    gain = posterior.expected_information_gain(actions)
    best = torch.nonzero(gain >= gain.max() - 1e-6).flatten().numpy()
    return int(np.random.default_rng(seed).choice(best)), gain


def greedy_design(
    theta_true: Tensor | ArrayLike,
    actions: Tensor | ArrayLike,
    *,
    num_rounds: int = 4,
    variant: str = "linear",
    chosen: Sequence[int] | None = None,
    seed: int,
) -> GreedyDesign:
    """Run the exact greedy campaign on data simulated at the truth.

    Round r draws from a generator seeded with (seed, r), its noise first, so that the
    noise does not depend on what was chosen before.

    Args:
        theta_true: The truth, shape (2,) or (1, 2).
        actions: Candidates, shape (a,) or (a, 1).
        num_rounds: Number of rounds.
        variant: The curve g, as in `ExactPosterior`.
        chosen: Index of each round's action, in place of the most informative one.
        seed: Non-negative seed of noise, ties and reproduction samples.

    Returns:
        The campaign.

    Example:
        >>> campaign = greedy_design([-3, 1], [-5, 0, 5], num_rounds=2, seed=0)
        >>> campaign.action.flatten()
        tensor([-5.,  5.], dtype=torch.float64)
    """
    truth, candidates = _as_truth(theta_true), as_actions(actions)
    posterior = ExactPosterior([], [], variant=variant)
    rounds = []
    for r in range(num_rounds):
        rng = np.random.default_rng([seed, r])
        noise = rng.standard_normal()
        index, gain = greedy_action(posterior, candidates, seed=rng)
        index = index if chosen is None else int(chosen[r])
        outcome = noise_free(truth, candidates[[index]], variant=variant).item()
        posterior = ExactPosterior(
            np.append(posterior.action, candidates[index]),
            np.append(posterior.x, outcome + noise),
            variant=variant,
        )
        error = reproduction_error(
            posterior.sample(10_000, seed=rng),
            truth,
            REPRODUCTION_ACTIONS,
            variant=variant,
        )
        rounds.append((gain[index], posterior.log_prob(truth)[0], error))
    gains, log_probs, errors = (torch.stack(each) for each in zip(*rounds, strict=True))
    return GreedyDesign(
        action=torch.from_numpy(posterior.action)[:, None],
        x=torch.from_numpy(posterior.x)[:, None],
        gain=gains,
        log_prob=log_probs,
        reproduction_error=errors,
    )


def reproduction_error(
    theta: Tensor | ArrayLike,
    theta_true: Tensor | ArrayLike,
    action: Tensor | ArrayLike,
    *,
    variant: str = "linear",
) -> Tensor:
    r"""How far outcomes under the posterior lie from the true ones.

    .. math::
        \frac1n \sum_i \left| f_\xi(\theta_i) - f_\xi(\theta^*) \right|

    Args:
        theta: Posterior samples, shape (n, 2).
        theta_true: The truth :math:`\theta^*`, shape (2,) or (1, 2).
        action: :math:`\xi`, shape (a,) or (a, 1).
        variant: The curve g, as in `ExactPosterior`.

    Returns:
        One error an action, shape (a,).
    """
    outcome = noise_free(theta, action, variant=variant)
    truth = noise_free(_as_truth(theta_true), action, variant=variant)
    return (outcome - truth).abs().mean(0)


def _as_truth(theta_true: Tensor | ArrayLike) -> np.ndarray:
    truth = as_parameters(np.atleast_2d(as_array(theta_true)))
    if len(truth) != 1:
        raise ValueError(
            f"expected one theta_true, shape (2,); got {truth.shape}; pass one"
        )
    return truth
