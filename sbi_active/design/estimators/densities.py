"""Densities of outcomes, one a class, that are fitted in milliseconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.inference.sampling.mixtures import StudentMixture, fitted_normals
from sbi_active.inference.sampling.weights import silverman

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
    fold, parts, rows = block % NUM_FOLDS, [], []
    for k in fold.unique().tolist():
        train, test = (torch.nonzero(part)[:, 0] for part in (fold != k, fold == k))
        parts.append(score(train, test))
        rows.append(test)
    scores = torch.cat(parts, 1).double()[:, torch.cat(rows).argsort()]
    result = torch.empty(len(block), dtype=torch.float64)
    for k in range(NUM_FOLDS):
        others = (scores * weight)[:, fold != k].sum(1)
        result[fold == k] = scores[int(others.argmax()), fold == k]
    return result


def by_pattern(
    simulations: CandidateSimulations, smallest: int
) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
    """Yield outcomes that count by which of their numbers are present.

    Each group has a candidate's number, rows (k,), the numbers present (p,) and their
    values (k, p); patterns of fewer rows than the smallest, but for one of all rows,
    join those without a number.
    """
    for a, counted in enumerate(simulations.counted):
        x = simulations.x[a].flatten(1).double()
        rows = torch.nonzero(counted)[:, 0]
        patterns, label = torch.unique(x[rows].isfinite(), dim=0, return_inverse=True)
        rest = []
        for k, pattern in enumerate(patterns):
            members = rows[label == k]
            columns = torch.nonzero(pattern)[:, 0]
            if len(columns) and len(members) >= min(smallest, len(rows)):
                yield a, members, columns, x[members][:, columns]
            else:
                rest.append(members)
        if rest:
            members = torch.cat(rest).sort().values
            yield a, members, torch.empty(0).long(), x[members, :0]


Reduction = Callable[[Tensor], Tensor]


def reduction(
    x: Tensor, target: Tensor, *, most: int = 6, ridge: float = 0.01, limit: float = 8.0
) -> Reduction:
    """Return a function that standardizes outcomes, and makes long ones short.

    Long outcomes are projected on the slopes of ridge regressions of the target's
    numbers on x, and on the leading principal components.

    Args:
        x: Outcomes, shape (n, q).
        target: Numbers to predict, shape (n, t).
        most: Numbers that are left of an outcome.
        ridge: Share of the total variance that a direction is penalized by.
        limit: Standard deviations beyond which a number is cut off.
    """
    n, q = x.shape
    if q == 0:
        return lambda new: new
    center, scale = x.mean(0), x.std(0)
    scale = torch.where(scale > 1e-30, scale, 1.0)

    def standard(new: Tensor) -> Tensor:
        return ((new - center) / scale).clamp(-limit, limit)

    if q <= most:
        return standard
    z = (x - center) / scale
    moment = z.T @ z / n + ridge * torch.eye(q)
    slope = torch.linalg.solve(moment, z.T @ (target - target.mean(0)) / n)
    left, value, _ = torch.linalg.svd(slope, full_matrices=False)
    slope = left[:, value > 1e-9 * value.amax()][:, : most - 2]
    leading = torch.linalg.eigh(moment).eigenvectors.flip(1)[:, :most]
    direction = torch.linalg.qr(torch.cat([slope, leading], 1)).Q[:, :most]
    direction = direction / (z @ direction).std(0)
    return lambda new: (standard(new) @ direction).clamp(-limit, limit)


def mixture(rows: Tensor, most: int) -> StudentMixture:
    """Fit a mixture of at most so many normals to rows (n, d)."""
    rng = np.random.default_rng(0)
    return fitted_normals(rows.numpy(), most, rng, num_iterations=40)


LogDensities = Callable[[Tensor], Tensor]


def class_members(
    x: Tensor, label: Tensor, enough: Tensor, *, sizes: tuple[int, ...] = (1, 6)
) -> list[LogDensities]:
    """Fit relative densities of each class: none, and mixtures of normals.

    Args:
        x: Outcomes, shape (n, q), q may be 0.
        label: Class, shape (n,).
        enough: Whether a class has rows enough for a density, shape (k,), bool; where
            one has not, only the first is fitted.
        sizes: Numbers of normals of a class.

    Returns:
        Functions of outcomes (m, q) that give log densities up to what is common to
        the classes, shape (m, k).
    """
    classes = range(len(enough))
    members: list[LogDensities] = [lambda new: new.new_zeros(len(new), len(enough))]
    if x.shape[1] == 0 or not bool(enough.all()):
        return members
    reduce = reduction(x, torch.nn.functional.one_hot(label).double())
    rows = [reduce(x[label == k]) for k in classes]
    fits = [[mixture(own, size) for own in rows] for size in sizes]
    return members + [_by_class(fit, reduce) for fit in fits]


def _by_class(mixtures: Sequence[StudentMixture], reduce: Reduction) -> LogDensities:
    def log_density(x: Tensor) -> Tensor:
        z = reduce(x).numpy()
        return torch.from_numpy(np.stack([m.log_prob(z) for m in mixtures], 1))

    return log_density


#: Numbers of an outcome up to which each kernel has a covariance of its own.
MOST_NUMBERS = 12


def noise_members(
    mean: Tensor, sd: Tensor, label: Tensor, enough: Tensor
) -> list[LogDensities]:
    r"""Return the density of each class by kernels about as narrow as the noise.

    .. math::
        f_k(x) = \frac1n \sum_i \mathcal N\bigl(x \mid a m_i + (1 - a) \bar m_k,\;
        \operatorname{diag}(s_i^2) + h^2 C_k\bigr), \qquad a = \sqrt{1 - h^2}

    with :math:`m_i` the outcomes without noise of posterior draws, :math:`s_i` the
    standard deviations of the noise, :math:`\bar m_k, C_k` mean and covariance of the
    former. With h = 0 it is the Monte Carlo average of the noise's density, which needs
    many draws where the posterior predictive is wider than the noise.

    Args:
        mean: Outcomes without noise, shape (n, q).
        sd: Standard deviation of the noise, shape (n, q).
        label: Class, shape (n,).
        enough: Whether a class has rows enough, shape (k,), bool; where one has not, or
            outcomes are long, there is no member.

    Returns:
        One function of outcomes (m, q) that gives log densities, shape (m, k), or none.

    References:
        West, Journal of the Royal Statistical Society B 55 (1993).
    """
    usable = 0 < mean.shape[1] <= MOST_NUMBERS and bool(enough.all())
    if not usable or not bool((mean.isfinite() & (sd > 0)).all()):
        return []
    known = mean.numpy(), sd.square().numpy()
    classes = [(label == k).numpy() for k in range(len(enough))]
    fits = [_noise_kernels(*(part[own] for part in known)) for own in classes]
    return [_by_class(fits, lambda new: new)]


def _noise_kernels(
    mean: Array, variance: Array, *, factor: float = 0.25, tail: float = 0.1
) -> StudentMixture:
    """Return the density of one class, by means and variances (n, q).

    Args:
        mean: Outcomes without noise.
        variance: Variances of the noise.
        factor: Factor of Silverman's rule; with one four times as large, the
            information of six pairs of models was the same to .007 nat.
        tail: Weight of a normal of all draws, for what lies between the kernels.
    """
    center, n = mean.mean(0), len(mean)
    apart = mean - center
    covariance = apart.T @ apart / (n - 1)
    # directions in which the kernels would lie apart without smoothing
    unit = variance.mean(0) ** -0.5
    spread = np.linalg.eigvalsh(unit[:, None] * covariance * unit)
    num_distinct = len({row.tobytes() for row in mean})
    d = max(1, int((spread > 1).sum()))
    h = min(factor * silverman(max(2, num_distinct), d), 1.0)
    knots = np.append(np.sqrt(1 - h**2) * apart, 0 * apart[:1], 0)
    own = variance[:, None] * np.eye(len(center)) + h**2 * covariance
    wide = variance.mean(0) * np.eye(len(center)) + covariance
    factors = np.linalg.cholesky(np.append(own, wide[None], 0))
    weights = np.append(np.full(n, (1 - tail) / n), tail)
    return StudentMixture(center + knots, factors, weights, np.inf)
