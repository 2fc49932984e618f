"""How well a trial was predicted, before it is used."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

__all__ = ["Score", "score_outcome"]

#: Numbers of x up to which a kernel estimate says more than a Gaussian.
MAX_DIM = 8
RIDGE = 1e-10  # of the variance, for numbers that never vary


@dataclass(frozen=True)
class Score:
    """How well an outcome was predicted.

    Attributes:
        surprise: Tail probability, in (0, 1].
        log_score: Log density, nats.
        num_simulations: Spent.
        num_missing: Of them lost to faults of the simulator.
    """

    surprise: float
    log_score: float
    num_simulations: int
    num_missing: int


def score_outcome(
    x: Tensor,
    action: Tensor,
    simulator: Callable[..., Any],
    belief: Distribution,
    *,
    num_samples: int,
    seed: int,
    engine: Mapping[str, Any] | None = None,
) -> Score:
    r"""Compare an outcome with simulations from the belief before it.

    .. math::
        p = \frac{1 + \#\{i : D(x_i) \ge D(x_o)\}}{n + 1}, \qquad
        x_i \sim p(x | \theta_i, \xi), \quad \theta_i \sim b,

    with D the Mahalanobis distance from the simulations' mean among those in which the
    same numbers were measured; outcomes whose pattern of measured numbers is rarer lie
    further out. If the belief is the posterior and the simulator right, p is
    uniform (never too small), and independent of the trials before it.

    The log score is that of an equal mixture of a Gaussian and a kernel estimate, of a
    Gaussian alone beyond 8 numbers, times the share of the pattern.

    Args:
        x: The outcome, shape x_shape; NaN where nothing was measured.
        action: The executed one, shape (action_dim,).
        simulator: ``simulator(theta, action)``.
        belief: Before the trial.
        num_samples: n.
        seed: Of the simulations.
        engine: Options of :func:`~sbi_active.simulation.simulate`.

    References:
        Dawid, J. R. Stat. Soc. A 1984 (prequential assessment).
    """
    with forked_generators(seed, "theta"):
        theta = belief.sample(torch.Size([num_samples]))
    rows = simulate(
        simulator,
        theta,
        action.expand(num_samples, -1),
        seed=derive_seed(seed, "x"),
        **(engine or {}),
    )
    drawn = rows.without_missing().x.double().flatten(1)
    observed = x.double().flatten()
    n = len(drawn)
    measured, own = drawn.isfinite(), observed.isfinite()
    patterns, label, count = measured.unique(
        dim=0, return_inverse=True, return_counts=True
    )
    same = (measured == own).all(1)
    num_same = int(same.sum())
    rarer = ~same & (count[label] <= num_same)
    beyond, log_density = num_same, 0.0
    if num_same and bool(own.any()):
        distance, log_density = _compare(drawn[same][:, own], observed[own])
        beyond = int((distance[:-1] >= distance[-1]).sum())
    elif bool(own.any()):  # no simulation had these numbers
        log_density = -math.inf
    return Score(
        surprise=(1 + int(rarer.sum()) + beyond) / (n + 1),
        log_score=log_density + math.log((num_same + 0.5) / (n + len(patterns))),
        num_simulations=num_samples,
        num_missing=num_samples - n,
    )


def _compare(drawn: Tensor, observed: Tensor) -> tuple[Tensor, float]:
    """Return squared distances, the observed one last, and the log density there."""
    n, q = drawn.shape
    mean = drawn.mean(0)
    variance = drawn.var(0, correction=0)
    covariance = variance.diag()
    if n > 2 * q:
        covariance = (drawn - mean).T @ (drawn - mean) / n
    scale = variance.max().clamp_min(1e-30)
    root = torch.linalg.cholesky(covariance + RIDGE * scale * torch.eye(q))
    both = torch.cat([drawn, observed[None]]) - mean
    z = torch.linalg.solve_triangular(root, both.T, upper=False).T
    distance = z.square().sum(1)
    log_unit = -root.diagonal().log().sum() - 0.5 * q * math.log(2 * math.pi)
    log_density = -0.5 * distance[-1]
    if n > 1 and q <= MAX_DIM:
        width = (4 / ((q + 2) * n)) ** (1 / (q + 4))
        gap = (z[:-1] - z[-1]).square().sum(1) / width**2
        kernel = (-0.5 * gap).logsumexp(0) - math.log(n) - q * math.log(width)
        log_density = torch.logaddexp(log_density, kernel) - math.log(2)
    return distance, float(log_density + log_unit)
