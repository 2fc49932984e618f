"""Densities of outcomes, one a class, that are fitted in milliseconds."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sbi_active.inference.sampling.weights import silverman
from sbi_active.information_gain.fits.reduction import Reduction

TEMPERATURES = (1.0, 0.5)  # powers of a density, against too much confidence
BANDWIDTHS = (0.5, 1.0)  # of Silverman's rule
SHRINKAGE = 5.0  # rows' worth of the common covariance in that of a class
DIRECTIONS = 3  # of equal means but other spreads, beside the discriminating ones
BLOCK = 2**22  # numbers at once

LogDensities = Callable[[Tensor], Tensor]


def class_members(
    x: Tensor, label: Tensor, enough: Tensor, *, kernels: bool = True
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
    shrunk = (scatter + SHRINKAGE * common) / (count - 1 + SHRINKAGE) + tiny
    densities: list[LogDensities] = [
        lambda new: _log_gaussians(new, mean, common.expand_as(shrunk)),
        lambda new: _log_gaussians(new, mean, shrunk),
    ]
    for factor in BANDWIDTHS if kernels else ():
        densities.append(lambda new, f=factor: _log_kernels(new, rows, shrunk, f, d))
    return members + [lambda new, f=density: f(reduce(new)) for density in densities]


def _discriminating(
    x: Tensor, label: Tensor, num_classes: int
) -> Callable[[Tensor], Tensor]:
    r"""Return a map to few numbers: :math:`W^{-1} (\mu_k - \mu)` and leading ones.

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
    vector = torch.linalg.eigh(other).eigenvectors[:, -DIRECTIONS:]
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
            for w in white.split(max(1, BLOCK // n))
        ]
        log_density = torch.cat(parts) - math.log(n) - d * math.log(width)
        log_tail = -0.5 * (white - knots.mean(0)).square().sum(1)
        log_density = torch.logaddexp(
            log_density + math.log(0.9), log_tail + math.log(0.1)
        )
        columns.append(log_density - root.diagonal().log().sum())
    return torch.stack(columns, 1)
