"""Smooth outcomes over the parameters: interpolated, or learned from noisy pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    noise_scale,
    whitening,
)
from sbi_active.design.estimators.entropy import pair_noise
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise

NUGGET = 1e-6  # of the variance: rounding leaves kernels of near rows singular


@dataclass(frozen=True)
class MeanEmulator:
    r"""Kriging with the Matern kernel of smoothness 5/2, one metric for all outcomes.

    .. math::
        \hat f(\theta) = B^\top (1, z) + k(z)^\top (K + \rho)^{-1} (F - Z B), \qquad
        z = W^\top (\theta - \mu), \quad
        k = (1 + s + s^2 / 3)\, e^{-s}, \; s = \sqrt 5\, |z - z_j|.

    All candidates share their parameters, hence one inverse serves them all. W is
    chosen by leave-one-out errors, first isotropic in whitened theta, then along the
    average slopes of the outcomes. The ridge of noisy outcomes, one for each of them,
    is chosen by these errors as well.

    Attributes:
        center: :math:`\mu`, shape (d,).
        transform: W, shape (d, d).
        knots: z of the simulations, shape (n, d).
        trend: B, shape (1 + d, q).
        weight: :math:`(K + \rho)^{-1} (F - Z B)`, shape (n, q).
        error: Leave-one-out errors, shape (n, q).

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
        ridges: Sequence[float] = (NUGGET,),
        lengths: Sequence[float] = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 6.0),
        bent: Sequence[float] = (0.7, 1.0, 1.4),
        num_choosing: int = 300,
    ) -> MeanEmulator:
        """Smooth outcomes (n, q) over parameters (n, d), in units of their noise.

        Args:
            theta: Parameters.
            f: Outcomes.
            ridges: Ridges, of which each outcome has the best; one that is small
                interpolates.
            lengths: Lengths to try, in standard deviations of the parameters.
            bent: Lengths to try along the slopes, in the best of these.
            num_choosing: Number of rows that choose the metric.
        """
        center, white = whitening(theta)
        unit = f.std(0) + 1

        def best(transform: Tensor, lengths: Sequence[float]) -> MeanEmulator:
            rows = theta[:num_choosing], f[:num_choosing], center
            fits = [MeanEmulator._solve(*rows, transform / s, ridges) for s in lengths]
            return min(fits, key=lambda fit: fit.score)

        first = best(white, lengths)
        slope = first.slope(first.knots) / unit[:, None]
        metric = torch.einsum("nqi,nqj->ij", slope, slope)
        metric = metric / metric.diagonal().mean().clamp_min(1e-30)
        along = torch.linalg.cholesky(metric + 0.01 * torch.eye(len(metric)))
        other = best(first.transform @ along, bent)
        chosen = min(first, other, key=lambda fit: fit.score)
        return MeanEmulator._solve(theta, f, center, chosen.transform, ridges)

    @staticmethod
    def _solve(
        theta: Tensor,
        f: Tensor,
        center: Tensor,
        transform: Tensor,
        ridges: Sequence[float],
    ) -> MeanEmulator:
        z = (theta - center) @ transform
        trend = torch.linalg.lstsq(linear(z), f).solution
        rest, correlation = f - linear(z) @ trend, kernel(z, z)
        weight = error = torch.full_like(rest, torch.inf)
        for ridge in ridges:
            inverse = torch.linalg.inv(correlation + ridge * torch.eye(len(z)))
            own = inverse @ rest
            missed = own / inverse.diagonal()[:, None]
            better = missed.square().mean(0) < error.square().mean(0)
            weight = torch.where(better, own, weight)
            error = torch.where(better, missed, error)
        return MeanEmulator(center, transform, z, trend, weight, error)

    @property
    def score(self) -> float:
        """Score of the metric, the lower the better.

        Metrics tie where errors are negligible, lest rounding choose among them.
        """
        return max(float(self.error.square().log1p().mean()), 1e-8)

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


def linear(z: Tensor) -> Tensor:
    """Return the features (1, z), shape (n, 1 + d)."""
    return torch.nn.functional.pad(z, (1, 0), value=1.0)


def kernel(z: Tensor, knots: Tensor) -> Tensor:
    """Return the Matern kernel of smoothness 5/2, shape (n, k)."""
    s = torch.cdist(z, knots).mul_(5**0.5)
    return s.div(3).add_(1).mul_(s).add_(1).mul_(s.neg_().exp_())


#: Ridges of outcomes that are learned from pairs.
RIDGES = tuple(10.0**k for k in range(-5, 2))


@dataclass(frozen=True)
class Emulated:
    """Simulations whose noise is declared or learned, and the emulator of their means.

    Attributes:
        simulations: Simulations with mean and noise, x of shape (a, n, q) where these
            are learned.
        emulator: Emulator of the means in units of the noise, a * q outcomes.
        scale: Root mean square of the noise of each number, shape (a, q).
        missed: Whether the emulator misses an outcome that it was not fitted to by more
            than the noise, shape (a, n).
    """

    simulations: CandidateSimulations
    emulator: MeanEmulator
    scale: Tensor
    missed: Tensor

    def columns(self, a: int) -> slice:
        """Return the outcomes of a candidate in the emulator."""
        q = self.scale.shape[1]
        return slice(a * q, (a + 1) * q)


def emulated(simulations: CandidateSimulations) -> Emulated:
    """Return declared simulations with their emulator, or learned ones."""
    if simulations.noise is None:
        return learned(simulations)
    assert simulations.mean is not None
    theta, scale = simulations.theta.double(), noise_scale(simulations)
    filled = fill(theta, simulations.mean.flatten(2).double()) / scale[:, None]
    emulator = MeanEmulator.fit(theta, filled.transpose(0, 1).flatten(1))
    missed = emulator.error.unflatten(1, scale.shape).square().mean(2).T > 1
    return Emulated(simulations, emulator, scale, missed)


def learned(simulations: CandidateSimulations) -> Emulated:
    r"""Return simulations of a model learned from pairs, whose noise is declared.

    The noise of a candidate is Gaussian with the covariance of the pairs' differences
    (:func:`.pair_noise`). Averages of pairs, whitened by it, are smoothed over theta
    (:class:`MeanEmulator`). Outcomes are drawn anew,
    :math:`\hat f(\theta_i) + \epsilon_i`, so that none had a part in its own mean.
    Averages are off by the noise, so that none counts as missed.
    """
    theta = simulations.theta.double()
    pairs = torch.stack(simulations.outcomes()).flatten(3).double()
    pairs = pairs.where(pairs.isfinite().all(-1, keepdim=True), torch.nan)
    _, num_actions, n, q = pairs.shape
    factor, _ = pair_noise(simulations)
    average = fill(theta, pairs.nanmean(0)).mT
    white = torch.linalg.solve_triangular(factor, average, upper=False).mT
    emulator = MeanEmulator.fit(theta, white.transpose(0, 1).flatten(1), ridges=RIDGES)
    mean = emulator(emulator.knots).reshape(n, num_actions, q).transpose(0, 1)
    known = (simulations.completeness > 0)[..., None]
    mean = torch.where(known, mean, torch.nan)
    with forked_generators(0, "smoothing"):
        x = mean + torch.randn(n, q, dtype=torch.float64)
    declared = replace(
        simulations, x=x, mean=mean, noise=GaussianNoise(1.0), replicate=None
    )
    one, none = torch.ones(num_actions, q).double(), torch.zeros(num_actions, n).bool()
    return Emulated(declared, emulator, one, none)


def fill(theta: Tensor, x: Tensor) -> Tensor:
    """Return outcomes (a, n, q), incomplete ones from the nearest complete one."""
    missing = ~x.isfinite().all(-1)
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
