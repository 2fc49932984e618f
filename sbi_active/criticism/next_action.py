"""The next action: the one whose outcome tells most about which rival is right."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.criticism.errors import log_sum_exp
from sbi_active.criticism.predictive import predict
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, NextAction, Tracing
from sbi_active.criticism.rival_set import RivalSet
from sbi_active.criticism.trials import Trials
from sbi_active.seeding import derive_seed

__all__ = ["choose_action"]

Array = NDArray[Any]

#: Rivals below this probability are left out.
NEGLIGIBLE = 0.01
MAX_RIVALS = 8
#: Information below which no action is worth a trial, nats.
NOTHING = 0.02
MAX_CANDIDATES = 64
#: Directions of the predictions in which rivals are compared.
MAX_DIRECTIONS = 6


def choose_action(
    rivals: RivalSet, tracing: Tracing, actions: ActionSpace
) -> NextAction:
    r"""Return the action of the largest information about the model index.

    .. math::
        I(k; x | \xi) \ge \sum_k p_k\, E_{p(x | k, \xi)}\left[\log
        \frac{q(x | k, \xi)}{\sum_j p_j\, q(x | j, \xi)}\right]

    for any densities q; here kernel estimates of each rival's posterior predictive on
    one half of its draws, scored on the other, and the other way round.

    Args:
        rivals: The models.
        tracing: Their probabilities.
        actions: The permitted ones.

    References:
        Barber & Agakov, Advances in Neural Information Processing Systems 16 (2003).
    """
    if isinstance(actions, DiscreteActions) and len(actions) <= MAX_CANDIDATES:
        candidates = actions.values.double()
    else:
        seed = derive_seed(rivals.seed, "candidates")
        candidates = actions.sample((MAX_CANDIDATES,), seed=seed).double()
    named = [n for n, p in tracing.probabilities.items() if p > NEGLIGIBLE][:MAX_RIVALS]
    p = np.array([tracing.probabilities[n] for n in named])
    gains = np.zeros(len(candidates))
    if len(named) > 1:
        following = _following(rivals, candidates)
        draws = [_draws(rivals, name, following) for name in named]
        trial = draws[0][1]
        for a in range(len(candidates)):
            gains[a] = _information([d[:, trial == a] for d, _ in draws], p / p.sum())
    best = int(np.argmax(gains))
    worth = gains[best] >= NOTHING
    return NextAction(
        action=candidates[best].numpy() if worth else None,
        candidates=candidates.numpy(),
        information_gain=gains,
        separates=(*named,),
    )


def _following(rivals: RivalSet, candidates: torch.Tensor) -> Trials:
    """Return each candidate as if it were the next trial."""
    own, num = rivals.trials, len(candidates)
    row = int(own.valid.int().argmax())
    x = own.x[row].nan_to_num()
    times = own.sample_times
    if times is not None and times.ndim == 2:
        times = times[row].nan_to_num().expand(num, -1)
    return Trials(
        candidates,
        x.expand(num, *x.shape),
        index=torch.full((num,), float(own.index.max()) + 1),
        sample_times=times,
        repeat_of=torch.full((num,), -1),
    )


def _draws(rivals: RivalSet, name: str, trials: Trials) -> tuple[Array, Array]:
    parts = name.split(" + ")
    names = tuple(n for n in parts if n in rivals.effects)
    error = name if name in (UNEXPLAINED, SCATTER) else None
    prediction = predict(rivals, trials, names=names, error=error)
    return prediction.x / np.exp(np.log(prediction.sd).mean(0)), prediction.trial


def _information(draws: list[Array], p: Array) -> float:
    """Return the cross-fitted bound for one action from each rival's draws."""
    draws = _compressed(draws)
    half = min(len(d) for d in draws) // 2
    total = 0.0
    for fit, score in (
        (slice(0, half), slice(half, None)),
        (slice(half, None), slice(0, half)),
    ):
        for k in range(len(draws)):
            x = draws[k][score]
            log_q = np.stack([_kernel_density(d[fit], x) for d in draws])
            mixture = log_sum_exp(log_q + np.log(p)[:, None], axis=0)
            total += 0.5 * p[k] * float((log_q[k] - mixture).mean())
    return max(total, 0.0)


def _compressed(draws: list[Array]) -> list[Array]:
    """Return the draws along the few directions in which the rivals differ most."""
    if draws[0].shape[1] <= MAX_DIRECTIONS:
        return draws
    pooled = np.concatenate(draws)
    middle = pooled.mean(0)
    _, _, directions = np.linalg.svd(pooled - middle, full_matrices=False)
    return [(d - middle) @ directions[:MAX_DIRECTIONS].T for d in draws]


def _kernel_density(points: Array, x: Array) -> Array:
    """Return log densities at x, shape (s, d), of a Gaussian kernel estimate."""
    n, d = points.shape
    width = points.std(0) * (4 / ((d + 2) * n)) ** (1 / (d + 4)) + 1e-9
    z = (x[:, None] - points[None]) / width
    log_k = -0.5 * (z**2).sum(-1) - np.log(width).sum() - 0.5 * d * np.log(2 * np.pi)
    return log_sum_exp(log_k, axis=1) - np.log(n)
