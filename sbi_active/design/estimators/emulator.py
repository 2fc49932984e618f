"""Smooth outcomes over the parameters: interpolated, or learned from noisy pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise

NUGGET = 1e-6  # of the variance: rounding leaves kernels of near rows singular
NUM_CHOOSING = 300  # rows that choose a metric


@dataclass(frozen=True)
class MeanEmulator:
    r"""Kriging with the Matern kernel of smoothness 5/2, one metric for all outcomes.

    .. math::
        \hat f(\theta) = B^\top (1, z) + k(z)^\top K^{-1} (F - Z B), \qquad
        z = W^\top (\theta - \mu), \quad
        k = (1 + s + s^2 / 3)\, e^{-s}, \; s = \sqrt 5\, |z - z_j|.

    All candidates share their parameters, hence one factor of K serves them all. W is
    chosen by leave-one-out errors, first isotropic in whitened theta, then along the
    average slopes of the outcomes.

    Attributes:
        center: :math:`\mu`, shape (d,).
        transform: W, shape (d, d).
        knots: z of the simulations, shape (n, d).
        trend: B, shape (1 + d, q).
        weight: :math:`K^{-1} (F - Z B)`, shape (n, q).
        error: Leave-one-out errors of the rows that chose the metric, shape (m, q).

    References:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section
        2.7 and Eq. 5.12.
    """

    center: Tensor
    transform: Tensor
    knots: Tensor
    trend: Tensor
    weight: Tensor
    error: Tensor

    @staticmethod
    def fit(
        theta: Tensor,
        f: Tensor,
        *,
        lengths: tuple[float, ...] = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 6.0),
    ) -> MeanEmulator:
        """Interpolate outcomes (n, q) over parameters (n, d), in negligible units.

        The lengths are those tried, in standard deviations of the parameters.
        """

        def judge(z: Tensor, f: Tensor) -> tuple[float, Tensor, Tensor]:
            error = _leave_one_out(z, f)
            # metrics tie where errors are negligible, lest rounding choose among them
            score = max(float(error.square().log1p().mean()), 1e-8)
            return score, error, f

        center, transform, error = choose_metric(theta, f, judge, lengths)
        return MeanEmulator._solve(theta, f, center, transform, error)

    @staticmethod
    def _solve(
        theta: Tensor, f: Tensor, center: Tensor, transform: Tensor, error: Tensor
    ) -> MeanEmulator:
        z = (theta - center) @ transform
        trend = torch.linalg.lstsq(linear(z), f).solution
        factor = torch.linalg.cholesky(kernel(z, z) + NUGGET * torch.eye(len(z)))
        weight = torch.cholesky_solve(f - linear(z) @ trend, factor)
        return MeanEmulator(center, transform, z, trend, weight, error)

    def coordinates(self, theta: Tensor) -> Tensor:
        """Return z of parameters, shape (n, d)."""
        return (theta - self.center) @ self.transform

    def parameters(self, z: Tensor) -> Tensor:
        """Return parameters of z, shape (n, d)."""
        return z @ torch.linalg.inv(self.transform) + self.center

    def __call__(self, z: Tensor, columns: slice = slice(None)) -> Tensor:
        """Return some of the outcomes at coordinates, shape (n, d) -> (n, q)."""
        trend, weight = self.trend[:, columns], self.weight[:, columns].contiguous()
        blocks = z.split(max(1, 2**18 // len(self.knots)))  # to stay in the cache
        return torch.cat(
            [linear(b) @ trend + kernel(b, self.knots) @ weight for b in blocks]
        )

    def slope(self, z: Tensor) -> Tensor:
        r"""Return the derivatives at coordinates, (n, d) -> (n, q, d).

        .. math::
            \partial k / \partial z = -\tfrac53 (1 + s) e^{-s} (z - z_j)
        """
        s = 5**0.5 * torch.cdist(z, self.knots)
        radial = -5 / 3 * (1 + s) * (-s).exp()
        columns = [
            (radial * (z[:, None, i] - self.knots[:, i])) @ self.weight
            + self.trend[1 + i]
            for i in range(z.shape[1])
        ]
        return torch.stack(columns, -1)


def whitening(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return the center of parameters and what whitens them, shapes (d,) and (d, d)."""
    d = theta.shape[1]
    size = theta.abs().amax(0).clamp_min(1e-30)
    spread = torch.maximum(theta.std(0), 1e-9 * size)  # of draws that are all alike
    covariance = torch.cov((theta / spread).T).reshape(d, d) + 1e-8 * torch.eye(d)
    factor = torch.linalg.cholesky(covariance)
    return theta.mean(0), torch.linalg.inv(factor).T / spread[:, None]


def linear(z: Tensor) -> Tensor:
    """Return the features (1, z), shape (n, 1 + d)."""
    return torch.nn.functional.pad(z, (1, 0), value=1.0)


def kernel(z: Tensor, knots: Tensor) -> Tensor:
    """Return the Matern kernel of smoothness 5/2, shape (n, k)."""
    s = torch.cdist(z, knots).mul_(5**0.5)
    return s.div(3).add_(1).mul_(s).add_(1).mul_(s.neg_().exp_())


def choose_metric(
    theta: Tensor,
    y: Tensor,
    judge: Callable[[Tensor, Tensor], tuple[float, Tensor, Tensor]],
    lengths: tuple[float, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the center of parameters (n, d), what makes z of them, and its errors.

    Some lengths are tried in whitened parameters, then some in the metric of the
    average slopes of the outcomes (n, q).

    Args:
        theta: Parameters.
        y: Outcomes.
        judge: Function of coordinates and outcomes that returns a score, the lower the
            better, errors of the outcomes, and what the slopes are those of.
        lengths: Lengths to try first.
    """
    center, white = whitening(theta)
    unit = y.std(0) + 1
    theta, y = theta[:NUM_CHOOSING], y[:NUM_CHOOSING]

    def choose(w: Tensor, lengths: tuple[float, ...]) -> tuple[float, Tensor, Tensor]:
        judged = [judge((theta - center) @ w / s, y)[:2] for s in lengths]
        best = min(range(len(lengths)), key=lambda i: judged[i][0])
        return *judged[best], w / lengths[best]

    score, error, transform = choose(white, lengths)
    smooth = judge((theta - center) @ transform, y)[2]
    emulator = MeanEmulator._solve(theta, smooth, center, transform, error)
    slope = emulator.slope(emulator.knots) / unit[:, None]
    metric = torch.einsum("nqi,nqj->ij", slope, slope)
    metric = metric / metric.diagonal().mean().clamp_min(1e-30)
    bent = transform @ torch.linalg.cholesky(metric + 0.01 * torch.eye(len(metric)))
    bent_score, bent_error, bent = choose(bent, (0.7, 1.0, 1.4))
    if bent_score < score:
        return center, bent, bent_error
    return center, transform, error


def _leave_one_out(z: Tensor, f: Tensor) -> Tensor:
    inverse = torch.linalg.inv(kernel(z, z) + NUGGET * torch.eye(len(z)))
    trend = linear(z) @ torch.linalg.lstsq(linear(z), f).solution
    return inverse @ (f - trend) / inverse.diagonal()[:, None]


@dataclass(frozen=True)
class Learned:
    """Simulations of a learned model, and what it was learned from.

    Attributes:
        simulations: Simulations in whitened coordinates with mean and noise, x of shape
            (a, n, q).
        score: Leave-one-out mean squares over their expectation under the noise, near 1
            where smoothing misses nothing, shape (a, q).
        difference: Difference of each pair, of unit mean square; zero for incomplete
            ones, (a, n, q).
        residual: Residual of each pair's average to the smoothed mean; zero if there
            is none, shape (a, n, q).
    """

    simulations: CandidateSimulations
    score: Tensor
    difference: Tensor
    residual: Tensor


def declare(simulations: CandidateSimulations) -> Learned:
    r"""Return simulations of a model learned from pairs, whose noise is declared.

    The noise of a candidate is Gaussian with the covariance of the pairs' differences,

    .. math::
        S = \frac{1}{2n} \sum_i (x_i - x_i') (x_i - x_i')^\top = L L^\top.

    Averages of pairs, whitened by L, are smoothed over theta by kernel ridge
    regression,

    .. math::
        \hat f = Q \Lambda (\Lambda + \rho)^{-1} Q^\top y, \qquad
        K = Q \Lambda Q^\top,

    with a ridge for each number of x and a metric for all, by leave-one-out errors.
    Outcomes are drawn anew, :math:`\hat f(\theta_i) + \epsilon_i`, so that none had a
    part in its own mean.
    """
    assert simulations.replicate is not None
    theta, complete = simulations.theta.double(), simulations.complete
    x, again = (
        torch.where(
            part.flatten(2).isfinite().all(-1, keepdim=True),
            part.flatten(2).double(),
            torch.nan,
        )
        for part in (simulations.x, simulations.replicate)
    )
    num_actions, n, q = x.shape
    difference = torch.where(complete[..., None], (x - again) / 2**0.5, 0.0)
    share = complete.sum(1).clamp_min(1)[:, None, None]
    floor = (
        torch.finfo(torch.float32).eps * x.abs().nan_to_num().amax(1)
    ).square() + 1e-300
    covariance = difference.mT @ difference / share + torch.diag_embed(floor)
    factor = torch.linalg.cholesky(covariance)
    average = fill(theta, torch.stack([x, again]).nanmean(0)).mT
    white = torch.linalg.solve_triangular(factor, average, upper=False).mT
    difference = torch.linalg.solve_triangular(factor, difference.mT, upper=False).mT
    f, square = _smooth(theta, white.transpose(0, 1).flatten(1))
    mean = f.reshape(n, num_actions, q).transpose(0, 1)
    known = (simulations.completeness > 0)[..., None]
    residual = torch.where(known, white - mean, 0.0)
    mean = torch.where(known, mean, torch.nan)
    with forked_generators(0, "smoothing"):
        x = mean + torch.randn(n, q, dtype=torch.float64)
    declared = replace(
        simulations, x=x, mean=mean, noise=GaussianNoise(1.0), replicate=None
    )
    return Learned(declared, 2 * square.reshape(num_actions, q), difference, residual)


def fill(theta: Tensor, x: Tensor) -> Tensor:
    """Return outcomes (a, n, q), incomplete ones from the nearest complete one."""
    missing = ~x.isfinite().all(-1)
    if not bool(missing.any()):
        return x
    x = x.clone()
    z = theta / theta.std(0).clamp_min(1e-30)
    for a in torch.nonzero(missing.any(1))[:, 0].tolist():
        complete = torch.nonzero(~missing[a])[:, 0]
        if len(complete) == 0:
            x[a] = 0.0
            continue
        nearest = torch.cdist(z[missing[a]], z[complete]).argmin(1)
        x[a, missing[a]] = x[a, complete[nearest]]
    return x


def _smooth(
    theta: Tensor,
    y: Tensor,
    lengths: tuple[float, ...] = (0.7, 1.0, 1.4, 2.0, 4.0),
) -> tuple[Tensor, Tensor]:
    """Return smoothed columns of y and their leave-one-out mean squares."""

    def judge(z: Tensor, y: Tensor) -> tuple[float, Tensor, Tensor]:
        f, square = _ridge(z, y)
        return float(square.log().mean()), square, f

    center, transform, _ = choose_metric(theta, y, judge, lengths)
    return _ridge((theta - center) @ transform, y)


def _ridge(
    z: Tensor, y: Tensor, powers: tuple[int, ...] = (-5, -4, -3, -2, -1, 0, 1)
) -> tuple[Tensor, Tensor]:
    """Return the smoothed y at the best ridge of each column and its score.

    The left-out rows choose one of some powers of ten.
    """
    ridges = 10.0 ** torch.tensor(powers, dtype=torch.float64)
    value, vector = torch.linalg.eigh(kernel(z, z))
    trend = linear(z) @ torch.linalg.lstsq(linear(z), y).solution
    rotated = vector.T @ (y - trend)
    scores = []
    for ridge in ridges:
        shrink = value / (value + ridge)
        leverage = vector.square() @ shrink
        error = (y - trend - vector @ (shrink[:, None] * rotated)).T / (1 - leverage)
        scores.append(error.square().mean(1))
    score, best = torch.stack(scores).min(0)
    shrink = value[:, None] / (value[:, None] + ridges[best])
    return trend + vector @ (shrink * rotated), score
