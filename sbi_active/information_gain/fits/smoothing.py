"""Noise-free outcomes and Gaussian noise, learned from pairs of outcomes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sbi_active.information_gain.base import CandidateSimulations
from sbi_active.information_gain.fits.emulator import kernel, linear, whitening
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise

LENGTHS = (0.7, 1.0, 1.4, 2.0, 4.0)  # in standard deviations of the belief
REFINED = (0.7, 1.0, 1.4)  # of the best, in the metric of slopes
#: A choice: powers of ten, of which the left-out rows choose one.
RIDGES = 10.0 ** torch.arange(-5.0, 2.0, dtype=torch.float64)
FEW = 300  # rows that choose the metric
FLOAT32 = 2.0**-23  # outcomes are float32: their rounding is a floor of the noise


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
    floor = (FLOAT32 * x.abs().nan_to_num().amax(1)).square() + 1e-300
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


def _smooth(theta: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return smoothed columns of y and their leave-one-out mean squares."""
    center, white = whitening(theta)

    def choose(w: Tensor, lengths: tuple[float, ...]) -> tuple[float, Tensor]:
        z, few = (theta[:FEW] - center) @ w, y[:FEW]
        scores = [float(_ridge(z / s, few)[1].log().mean()) for s in lengths]
        best = min(range(len(lengths)), key=scores.__getitem__)
        return scores[best], w / lengths[best]

    score, transform = choose(white, LENGTHS)
    z = (theta[:FEW] - center) @ transform
    f = _ridge(z, y[:FEW])[0]
    # slopes of the smoothed outcomes by local differences, weighted by the kernel
    weight = kernel(z, z)
    offset = z[:, None] - z
    moment = torch.einsum("nm,nmi,nmj->nij", weight, offset, offset)
    moment = moment + 1e-6 * torch.eye(z.shape[1])
    change = torch.einsum("nm,nmi,mq->niq", weight, -offset, f)
    change = change + torch.einsum("nm,nmi,nq->niq", weight, offset, f)
    slope = torch.linalg.solve(moment, change) / (f.std(0) + 1)
    metric = torch.einsum("niq,njq->ij", slope, slope)
    metric = metric / metric.diagonal().mean().clamp_min(1e-30)
    bent = transform @ torch.linalg.cholesky(metric + 0.01 * torch.eye(z.shape[1]))
    bent_score, bent = choose(bent, REFINED)
    best = bent if bent_score < score else transform
    return _ridge((theta - center) @ best, y)


def _ridge(z: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smoothed y at the best ridge of each column and its score."""
    value, vector = torch.linalg.eigh(kernel(z, z))
    trend = linear(z) @ torch.linalg.lstsq(linear(z), y).solution
    rotated = vector.T @ (y - trend)
    scores = []
    for ridge in RIDGES:
        shrink = value / (value + ridge)
        leverage = vector.square() @ shrink
        error = (y - trend - vector @ (shrink[:, None] * rotated)).T / (1 - leverage)
        scores.append(error.square().mean(1))
    score, best = torch.stack(scores).min(0)
    shrink = value[:, None] / (value[:, None] + RIDGES[best])
    return trend + vector @ (shrink * rotated), score
