"""Conditional densities q(u | x) that are fitted in milliseconds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.information_gain.fits.emulator import kernel, linear
from sbi_active.information_gain.fits.reduction import Reduction

LOG_2PI = math.log(2 * math.pi)
#: A choice: powers of ten, of which the left-out rows choose one.
RIDGES = 10.0 ** torch.arange(-6.0, 3.0, dtype=torch.float64)
LENGTHS = (0.3, 1.0, 3.0, 10.0)  # in standard deviations of x
FEW = 300  # rows that choose the length
DEFENSE = 0.02  # share of a standard normal in every density
NUM_COMPONENTS = 6  # at most, with four rows for each number of a mean: a choice
NUM_STEPS = 40  # of expectation maximization
FLOOR = 1e-3  # variance of a component, that of the rows being 1

Density = Callable[[Tensor, Tensor], Tensor]


def conditional_members(u: Tensor, x: Tensor) -> list[Density]:
    """Fit conditional densities of u (n, s), close to standard normal, given x (n, q).

    The order is: a Gaussian without x; Gaussians around a linear, a quadratic and a
    kernel regression, each with a constant covariance and with one that is scaled by a
    log-linear function of x; a mixture of Gaussians of (u, x), conditioned on x. Each
    has a share of the standard normal, so that no row costs more than a few nats. They
    are functions of u (k, s) and x (k, q), which may have no numbers, -> (k,).
    """
    members: list[Density] = [_Residual.fit(u, None).density()]
    if x.shape[1] == 0:
        members.append(_mixture(u, x, lambda x: x))
    else:
        reduce = Reduction.fit(x, torch.cat([u, u.square()], 1))
        z = reduce(x)
        regressions = [
            _linear(reduce.standard(x), u, reduce.standard),
            _linear(_quadratic(z), u, lambda x: _quadratic(reduce(x))),
            _kernel(z, u, reduce),
        ]
        for mean, residual in regressions:
            members.append(_Residual.fit(residual, None).density(mean))
            scale = _Residual.fit(residual, _quadratic(z))
            members.append(scale.density(mean, lambda x: _quadratic(reduce(x))))
        members.append(_mixture(u, z, reduce))
    return [_defended(member) for member in members]


def log_normal(u: Tensor) -> Tensor:
    """Log density of the standard normal, (n, s) -> (n,)."""
    return -0.5 * (u.square() + LOG_2PI).sum(-1)


def _defended(member: Density) -> Density:
    return lambda u, x: torch.logaddexp(
        member(u, x) + math.log(1 - DEFENSE), log_normal(u) + math.log(DEFENSE)
    )


@dataclass(frozen=True)
class _Residual:
    r"""Gaussian residuals, :math:`r \sim N(m, s^2(x) L L^\top)`.

    Attributes:
        location: m, shape (s,).
        factor: L, shape (s, s).
        slope: Slope of log s in features of x; None if s is 1.
        offset: Offset of log s.
    """

    location: Tensor
    factor: Tensor
    slope: Tensor | None
    offset: float

    @staticmethod
    def fit(residual: Tensor, features: Tensor | None) -> _Residual:
        n, s = residual.shape
        location = residual.mean(0)
        centered = residual - location
        covariance = centered.T @ centered / n + 1e-10 * torch.eye(s)
        factor = torch.linalg.cholesky(covariance)
        if features is None:
            return _Residual(location, factor, None, 0.0)
        white = torch.linalg.solve_triangular(factor, centered.T, upper=False)
        log_square = (white.square().mean(0) + 1e-3).log()
        slope = _ridge(features, log_square[:, None])[0]
        log_scale = (0.5 * (linear(features) @ slope)[:, 0]).clamp(-6, 6)
        offset = 0.5 * float((white.square() / (2 * log_scale).exp()).mean().log())
        return _Residual(location, factor, slope, offset)

    def density(
        self,
        mean: Callable[[Tensor], Tensor] | None = None,
        features: Callable[[Tensor], Tensor] | None = None,
    ) -> Density:
        log_det = self.factor.diagonal().log().sum()

        def log_density(u: Tensor, x: Tensor) -> Tensor:
            centered = (u if mean is None else u - mean(x)) - self.location
            log_scale = torch.zeros(len(u), dtype=u.dtype)
            if features is not None and self.slope is not None:
                log_scale = 0.5 * (linear(features(x)) @ self.slope)[:, 0]
                log_scale = log_scale.clamp(-6, 6) + self.offset
            white = torch.linalg.solve_triangular(self.factor, centered.T, upper=False)
            square = white.square().sum(0) / (2 * log_scale).exp()
            return -0.5 * (square + u.shape[1] * (LOG_2PI + 2 * log_scale)) - log_det

        return log_density


Regression = tuple[Callable[[Tensor], Tensor], Tensor]


def _linear(
    features: Tensor, u: Tensor, transform: Callable[[Tensor], Tensor]
) -> Regression:
    """Ridge regression and its leave-one-out residuals."""
    slope, residual = _ridge(features, u)
    return lambda x: linear(transform(x)) @ slope, residual


def _ridge(features: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes with intercept (1 + p, s), leave-one-out residuals, at the best ridge."""
    center, middle = features.mean(0), u.mean(0)
    left, value, right = torch.linalg.svd(features - center, full_matrices=False)
    rotated = left.T @ (u - middle)
    best: tuple[float, Tensor, Tensor] | None = None
    for ridge in RIDGES * len(u):
        shrink = value.square() / (value.square() + ridge)
        leverage = left.square() @ shrink + 1 / len(u)
        residual = u - middle - left @ (shrink[:, None] * rotated)
        residual = residual / (1 - leverage).clamp_min(1e-6)[:, None]
        score = float(residual.square().mean(0).log().sum())
        if best is None or score < best[0]:
            per_value = value / (value.square() + ridge)
            best = (score, right.T @ (per_value[:, None] * rotated), residual)
    assert best is not None
    intercept = middle - center @ best[1]
    return torch.cat([intercept[None], best[1]]), best[2]


def _kernel(z: Tensor, u: Tensor, reduce: Reduction) -> Regression:
    """Kernel ridge regression around a linear trend, leave-one-out residuals."""
    slope, _ = _ridge(z, u)
    rest = u - linear(z) @ slope
    few = [_smooth(z[:FEW], rest[:FEW], length)[0] for length in LENGTHS]
    length = LENGTHS[min(range(len(few)), key=few.__getitem__)]
    _, weight, residual = _smooth(z, rest, length)

    def mean(x: Tensor) -> Tensor:
        new = reduce(x)
        return linear(new) @ slope + kernel(new / length, z / length) @ weight

    return mean, residual


def _smooth(z: Tensor, rest: Tensor, length: float) -> tuple[float, Tensor, Tensor]:
    """Return score, weights and leave-one-out residuals at the best ridge."""
    value, vector = torch.linalg.eigh(kernel(z / length, z / length))
    rotated = vector.T @ rest
    best: tuple[float, Tensor, Tensor] | None = None
    for ridge in RIDGES:
        inverse = 1 / (value.clamp_min(0) + ridge)
        weight = vector @ (inverse[:, None] * rotated)
        residual = weight / (vector.square() @ inverse)[:, None]
        score = float(residual.square().mean(0).log().sum())
        if best is None or score < best[0]:
            best = (score, weight, residual)
    assert best is not None
    return best


def _quadratic(z: Tensor) -> Tensor:
    i, j = torch.triu_indices(z.shape[1], z.shape[1])
    return torch.cat([z, z[:, i] * z[:, j]], 1).clamp(-30, 30)


def _mixture(u: Tensor, z: Tensor, reduce: Callable[[Tensor], Tensor]) -> Density:
    """Conditional density of a Gaussian mixture of (u, z), by EM from spread rows.

    References:
        Bishop, Pattern Recognition and Machine Learning, 2006, section 9.2.
    """
    rows = torch.cat([u, z], 1)
    n, d = rows.shape
    num = min(NUM_COMPONENTS, max(1, n // (4 * d)))
    order = (rows @ torch.ones(d, dtype=rows.dtype)).argsort()
    mean = rows[order[((torch.arange(num) + 0.5) / num * n).long()]]
    spread = torch.cov(rows.T).reshape(d, d) + FLOOR * torch.eye(d)
    covariance = spread.expand(num, d, d).clone()
    log_weight = torch.full((num,), -math.log(num), dtype=rows.dtype)
    for _ in range(NUM_STEPS):
        log_joint = log_weight + _log_gaussians(rows, mean, covariance)
        share = log_joint.softmax(1)
        count = share.sum(0) + 1e-9
        mean = (share.T @ rows) / count[:, None]
        offset = rows - mean[:, None]
        covariance = (offset * share.T[..., None]).mT @ offset
        # one row's worth of the overall spread, and a floor
        covariance = (covariance + spread / num) / (count + 1)[:, None, None]
        covariance = covariance + FLOOR**2 * torch.eye(d)
        log_weight = (count / count.sum()).log()
    s = u.shape[1]

    def log_density(u: Tensor, x: Tensor) -> Tensor:
        z = reduce(x)
        joint = _log_gaussians(torch.cat([u, z], 1), mean, covariance)
        if z.shape[1] == 0:
            return (joint + log_weight).logsumexp(1)
        marginal = _log_gaussians(z, mean[:, s:], covariance[:, s:, s:])
        joint, marginal = joint + log_weight, marginal + log_weight
        return joint.logsumexp(1) - marginal.logsumexp(1)

    return log_density


def _log_gaussians(rows: Tensor, mean: Tensor, covariance: Tensor) -> Tensor:
    """Log density of each row under each component, shape (n, k)."""
    factor = torch.linalg.cholesky(covariance)
    offset = (rows - mean[:, None]).mT  # (k, d, n)
    white = torch.linalg.solve_triangular(factor, offset, upper=False)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    d = rows.shape[1]
    return (-0.5 * (white.square().sum(1) + d * LOG_2PI) - log_det[:, None]).T
