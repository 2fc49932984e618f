"""Densities of outcomes, one a class, that are fitted in milliseconds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.design.estimators.base import CandidateSimulations
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


def by_pattern(
    simulations: CandidateSimulations, smallest: int
) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
    """Yield outcomes that count by which of their numbers are present.

    Each group has a candidate's number, rows (k,), the numbers present (p,) and their
    values (k, p); patterns of fewer rows than the smallest join those without a number.
    """
    for a, counted in enumerate(simulations.counted):
        x = simulations.x[a].flatten(1).double()
        rows = torch.nonzero(counted)[:, 0]
        patterns, label = torch.unique(x[rows].isfinite(), dim=0, return_inverse=True)
        rest = []
        for k, pattern in enumerate(patterns):
            members = rows[label == k]
            columns = torch.nonzero(pattern)[:, 0]
            if len(columns) and len(members) >= smallest:
                yield a, members, columns, x[members][:, columns]
            else:
                rest.append(members)
        if rest:
            members = torch.cat(rest).sort().values
            yield a, members, torch.empty(0).long(), x[members, :0]


@dataclass(frozen=True)
class Reduction:
    r"""Standardized outcomes, or the directions of them that predict the target.

    Long outcomes are projected on the slopes of ridge regressions of the target's
    numbers on x, and on the leading principal components, six in all.

    Attributes:
        center: Center of the outcomes, shape (q,).
        scale: Scale of the outcomes, shape (q,).
        direction: Directions, shape (q, r).
        limit: Standard deviations beyond which a number is cut off.
    """

    center: Tensor
    scale: Tensor
    direction: Tensor
    limit: float = 8.0

    @staticmethod
    def fit(
        x: Tensor, target: Tensor, *, most: int = 6, ridge: float = 0.01
    ) -> Reduction:
        """Fit to outcomes (n, q) and numbers to predict (n, t).

        Outcomes of at most ``most`` numbers need no reduction. The ridge is the share
        of the total variance that a direction is penalized by.
        """
        n, q = x.shape
        center, scale = x.mean(0), x.std(0)
        scale = torch.where(scale > 1e-30, scale, 1.0)
        z = (x - center) / scale
        if q <= most:
            return Reduction(center, scale, torch.eye(q, dtype=x.dtype))
        moment = z.T @ z / n + ridge * torch.eye(q)
        slope = torch.linalg.solve(moment, z.T @ (target - target.mean(0)) / n)
        left, value, _ = torch.linalg.svd(slope, full_matrices=False)
        slope = left[:, value > 1e-9 * value.amax()][:, : most - 2]
        leading = torch.linalg.eigh(moment).eigenvectors.flip(1)[:, :most]
        direction = torch.linalg.qr(torch.cat([slope, leading], 1)).Q[:, :most]
        return Reduction(center, scale, direction / (z @ direction).std(0))

    def standard(self, x: Tensor) -> Tensor:
        """Return all numbers standardized, shape (n, q)."""
        return ((x - self.center) / self.scale).clamp(-self.limit, self.limit)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the reduced outcomes, shape (n, r)."""
        return (self.standard(x) @ self.direction).clamp(-self.limit, self.limit)


LogDensities = Callable[[Tensor], Tensor]


def class_members(
    x: Tensor,
    label: Tensor,
    enough: Tensor,
    *,
    kernels: bool = True,
    bandwidths: tuple[float, ...] = (0.5, 1.0),
    shrinkage: float = 5.0,
) -> list[LogDensities]:
    """Fit relative densities of each class, in several ways.

    The order is: none; Gaussians with a common covariance; Gaussians with one each,
    shrunk to the common one; kernel densities with these covariances.

    Args:
        x: Outcomes, shape (n, q), q may be 0.
        label: Class, shape (n,).
        enough: Whether a class has rows enough for a density, shape (k,), bool; where
            one has not, only the first is fitted.
        kernels: Whether to fit kernel densities, the dearest ones.
        bandwidths: Bandwidths, in those of Silverman's rule.
        shrinkage: Rows' worth of the common covariance in that of a class.

    Returns:
        Functions of outcomes (m, q) that give log densities up to what is common to
        the classes, shape (m, k).
    """
    num_classes = len(enough)
    members: list[LogDensities] = [
        lambda new: torch.zeros(len(new), num_classes, dtype=torch.float64)
    ]
    if x.shape[1] == 0 or not bool(enough.all()):
        return members
    reduce = _discriminating(x, label, num_classes)
    z = reduce(x)
    d = z.shape[1]
    rows = [z[label == k] for k in range(num_classes)]
    mean = torch.stack([row.mean(0) for row in rows])
    scatter = torch.stack(
        [(r - m).T @ (r - m) for r, m in zip(rows, mean, strict=True)]
    )
    tiny = 1e-8 * z.var(0).clamp_min(1e-30).diag()
    common = scatter.sum(0) / (len(z) - num_classes) + tiny
    count = torch.tensor([len(row) for row in rows])[:, None, None]
    shrunk = (scatter + shrinkage * common) / (count - 1 + shrinkage) + tiny
    densities: list[LogDensities] = [
        lambda new: _log_gaussians(new, mean, common.expand_as(shrunk)),
        lambda new: _log_gaussians(new, mean, shrunk),
    ]
    for factor in bandwidths if kernels else ():
        densities.append(lambda new, f=factor: _log_kernels(new, rows, shrunk, f, d))
    return members + [lambda new, f=density: f(reduce(new)) for density in densities]


def _discriminating(
    x: Tensor, label: Tensor, num_classes: int, num_spreads: int = 3
) -> Callable[[Tensor], Tensor]:
    r"""Return a map to few numbers: :math:`W^{-1} (\mu_k - \mu)` and leading ones.

    Beside them are some directions of equal means but other spreads.

    References:
        Ledoit & Wolf, J. Multivariate Analysis 2004 (the shrinkage of W).
    """
    indicator = torch.nn.functional.one_hot(label, num_classes).double()
    first = Reduction.fit(x, indicator)
    if x.shape[1] <= first.direction.shape[1]:
        return first
    z = first.standard(x)
    share = indicator / indicator.sum(0)
    mean = share.T @ z
    within = z - mean[label]
    moment = within.T @ within / len(z)
    n, q = z.shape
    target = moment.diagonal().mean() * torch.eye(q)
    spread = (within.square().sum(1).square().sum() / n - moment.square().sum()) / n
    share_of_target = (spread / (moment - target).square().sum()).clamp(1e-4, 1.0)
    shrunk = (1 - share_of_target) * moment + share_of_target * target
    means = torch.linalg.solve(shrunk, (mean - mean.mean(0)).T)
    left, value, _ = torch.linalg.svd(means, full_matrices=False)
    left = left[:, value > 1e-9 * value.amax()][:, : num_classes - 1]
    factor = torch.linalg.cholesky(shrunk)
    white = torch.linalg.solve_triangular(factor, within.T, upper=False).T
    # directions whose spread differs most between the classes
    moments = torch.stack(
        [white[label == k].T @ white[label == k] for k in range(num_classes)]
    )
    moments = moments / indicator.sum(0)[:, None, None]
    other = (moments - moments.mean(0)).square().sum(0)
    vector = torch.linalg.eigh(other).eigenvectors[:, -num_spreads:]
    spreads = torch.linalg.solve_triangular(factor.T, vector, upper=True)
    direction = torch.cat([left, spreads], 1)
    return lambda new: first.standard(new) @ direction


def _log_gaussians(z: Tensor, mean: Tensor, covariance: Tensor) -> Tensor:
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, (z - mean[:, None]).mT, upper=False)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (-0.5 * white.square().sum(1) - log_det[:, None]).T


def _log_kernels(
    z: Tensor, rows: list[Tensor], covariance: Tensor, factor: float, d: int
) -> Tensor:
    """Log kernel densities with Gaussian tails of each class, shape (m, k)."""
    columns = []
    for row, spread in zip(rows, covariance, strict=True):
        n = len(row)
        width = factor * silverman(n, d)
        root = torch.linalg.cholesky(spread)
        white, knots = (
            torch.linalg.solve_triangular(root, part.T, upper=False).T
            for part in (z, row)
        )
        parts = [
            (-0.5 * torch.cdist(w, knots).square() / width**2).logsumexp(1)
            for w in white.split(max(1, 2**22 // n))
        ]
        log_density = torch.cat(parts) - math.log(n) - d * math.log(width)
        log_tail = -0.5 * (white - knots.mean(0)).square().sum(1)
        log_density = torch.logaddexp(
            log_density + math.log(0.9), log_tail + math.log(0.1)
        )
        columns.append(log_density - root.diagonal().log().sum())
    return torch.stack(columns, 1)


#: Numbers of an outcome up to which each kernel has a covariance of its own.
MOST_NUMBERS = 12


def noise_members(
    mean: Tensor,
    sd: Tensor,
    label: Tensor,
    enough: Tensor,
    *,
    factors: tuple[float, ...] = (0.25, 1.0),
) -> list[LogDensities]:
    r"""Return densities of each class by kernels as narrow as the noise.

    .. math::
        f_k(x) = \frac1n \sum_i \mathcal N\bigl(x \mid a m_i + (1 - a) \bar m_k,\;
        \operatorname{diag}(s_i^2) + h^2 C_k\bigr), \qquad a = \sqrt{1 - h^2}

    with :math:`m_i` the outcomes without noise of posterior draws, :math:`s_i` the
    standard deviations of the noise, :math:`\bar m_k, C_k` mean and covariance of the
    former. With h = 0 it is the Monte Carlo average of the noise's density, which needs
    many draws where the posterior predictive is wider than the noise; with h = 1 it is
    Gaussian.

    Args:
        mean: Outcomes without noise, shape (n, q).
        sd: Standard deviation of the noise, shape (n, q).
        label: Class, shape (n,).
        enough: Whether a class has rows enough, shape (k,), bool; where one has not, or
            outcomes are long, there are no members.
        factors: Widths h, in those of Silverman's rule.

    Returns:
        Functions of outcomes (m, q) that give log densities, shape (m, k).

    References:
        West, Journal of the Royal Statistical Society B 55 (1993).
    """
    usable = 0 < mean.shape[1] <= MOST_NUMBERS and bool(enough.all())
    if not usable or not bool((mean.isfinite() & (sd > 0)).all()):
        return []

    def member(factor: float) -> LogDensities:
        classes = [label == k for k in range(len(enough))]
        parts = [_noise_kernels(mean[own], sd[own], factor) for own in classes]
        return lambda new: torch.stack([part(new) for part in parts], 1)

    return [member(factor) for factor in factors]


def _noise_kernels(mean: Tensor, sd: Tensor, factor: float) -> LogDensities:
    """Return the log density of one class, by means and deviations (n, q).

    A tenth is a Gaussian of all draws, for what lies between the kernels.
    """
    n = len(mean)
    center = mean.mean(0)
    apart = mean - center
    covariance = apart.T @ apart / (n - 1)
    noise = sd.square()
    # directions in which the kernels would lie apart without smoothing
    unit = noise.mean(0).rsqrt()
    spread = torch.linalg.eigvalsh(unit[:, None] * covariance * unit)
    num_distinct = len({row.tobytes() for row in mean.numpy()})
    d = max(1, int((spread > 1).sum()))
    h = min(factor * silverman(max(2, num_distinct), d), 1.0)
    knots = center + math.sqrt(1 - h**2) * apart
    factors = torch.linalg.cholesky(noise.diag_embed() + h**2 * covariance)
    wide = torch.linalg.cholesky(noise.mean(0).diag() + covariance)

    def log_density(x: Tensor) -> Tensor:
        kernels = _log_normal(x - knots[:, None], factors)
        inner = kernels.logsumexp(0) - math.log(n)
        tail = _log_normal((x - center)[None], wide[None])[0]
        return torch.logaddexp(inner + math.log1p(-0.1), tail + math.log(0.1))

    return log_density


def _log_normal(apart: Tensor, factor: Tensor) -> Tensor:
    """Return log N(apart | 0, L L^T), shape (n, m), from (n, m, q) and (n, q, q)."""
    if factor.shape[-1] == 1:
        white, log_det = apart / factor, factor[:, 0, 0].log()
    else:
        white = torch.linalg.solve_triangular(factor, apart.mT, upper=False).mT
        log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = 0.5 * factor.shape[-1] * math.log(2 * math.pi)
    return -0.5 * white.square().sum(-1) - log_det[:, None] - constant
