"""Scores of a trial's prediction, made before the trial is used.

Outcomes are compared by a Gaussian spread of rows of numbers, few or many, some of them
not measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.distributions import LowRankMultivariateNormal

from sbi_active.inference.sampling.weights import silverman

#: Shares of the diagonal among which the leave-one-out likelihood chooses.
SHARES = torch.logspace(-10, 0, 21, dtype=torch.float64)
FLOOR = 1e-10  # of a variance: the least that counts beside it, and beside a size


def score_outcome(x: Tensor, simulated: Tensor) -> tuple[float, float]:
    r"""Return tail probability and log score of an outcome among simulations.

    .. math::
        p = \frac{\#\{i \le n + 1 : D(x_i) \ge D(x_{n + 1})\}}{n + 1}, \qquad
        x_i \sim p(x | \theta_i, \xi), \quad \theta_i \sim b,

    with :math:`x_{n + 1}` the outcome and D the Mahalanobis distance by the mean and
    covariance of all n + 1, which are exchangeable if the belief is the posterior and
    the simulator right: p is then uniform (never too small) whatever the number of
    numbers, and independent of the trials before it. It is at least 1 / (n + 1),
    however far the outcome lies: what no draw reaches is no evidence beyond that.

    Outcomes without a measurement, or those with one, lie further out the rarer they
    are. In a partly measured trial, only the measured numbers are compared with those
    of the simulations, so that a sensor that drops out is no surprise. A
    simulator that itself leaves numbers out may be the cause as well; p is then the
    larger of the two tail probabilities. Numbers that are there where simulations
    seldom have them do count.

    The log score is that of an equal mixture of a Gaussian and a kernel estimate, of a
    Gaussian alone beyond 8 numbers, fitted to the simulations that have these numbers,
    times the share of those.

    Args:
        x: The outcome, shape x_shape; NaN where nothing was measured.
        simulated: Outcomes of its action under the belief before it, shape
            (n, *x_shape).

    Returns:
        p in (0, 1], and the log score in nats.

    References:
        Dawid, J. R. Stat. Soc. A 1984 (prequential assessment); Vovk, Gammerman &
        Shafer, Algorithmic Learning in a Random World, 2005 (conformal p-values).
    """
    observed, drawn = x.double().flatten(), simulated.double().flatten(1)
    drawn = torch.where(drawn.isfinite(), drawn, torch.nan)
    return _surprise(torch.cat([drawn, observed[None]])), _log_score(drawn, observed)


def _surprise(rows: Tensor) -> float:
    """Return the tail probability of the last row among all, shape (n + 1, q)."""
    present = rows.isfinite()
    own = present[-1]
    if own.all() or not own.any():
        return _tail(rows)
    by_sensor = _tail(torch.where(own, rows, torch.nan))
    is_partial = present.any(1) & ~present.all(1)
    if not is_partial[:-1].any():
        return by_sensor
    return max(by_sensor, _tail(rows))


def _tail(rows: Tensor) -> float:
    """Return the share of rows that lie as far out as the last, itself included."""
    measured = rows.isfinite().any(1)
    same = measured == measured[-1]
    num_same, num_other = int(same.sum()), int((~same).sum())
    beyond = num_same
    if measured[-1]:
        beyond = int(_ranks(_unusual(rows[measured]))[-1])
    return (beyond + (num_other if num_other <= num_same else 0)) / len(rows)


def _unusual(rows: Tensor) -> Tensor:
    """Return how unusual each row is by its numbers or by having them, shape (n,)."""
    by_number = _ranks(_distance(rows))
    present = rows.isfinite()
    if bool((present == present[0]).all()):
        return -by_number
    return -torch.minimum(by_number, _ranks(-_num_with(present)))


def _distance(rows: Tensor) -> Tensor:
    """Return distances that rows with fewer numbers share with others, shape (n,)."""
    count = rows.isfinite().sum(1)
    share = (Spread.of(rows).distance / count).pow(1 / 3)  # about Gaussian
    return (share - 1 + 2 / (9 * count)) * count.sqrt()  # Wilson & Hilferty, 1931


def _num_with(present: Tensor) -> Tensor:
    """Return how many rows have all the numbers that each row has, shape (n,)."""
    patterns, label, count = present.float().unique(
        dim=0, return_inverse=True, return_counts=True
    )
    contains = patterns @ patterns.T == patterns.sum(1, keepdim=True)
    return (contains.double() @ count.double())[label]


def _ranks(value: Tensor, rounding: float = 1e-9) -> Tensor:
    """Return how many entries are as large as each, but for rounding, shape (n,)."""
    ordered = value.sort().values
    slack = rounding * (1 + value.abs())
    return len(value) - torch.searchsorted(ordered, value - slack).double()


def _log_score(drawn: Tensor, observed: Tensor) -> float:
    """Return the log density of the outcome times the share that are of its kind."""
    own, present = observed.isfinite(), drawn.isfinite()
    is_measured = bool(own.any())
    same = (present | ~own).all(1) if is_measured else ~present.any(1)
    num_same, num_kinds = int(same.sum()), len(same.unique())
    log_share = math.log((num_same + 0.5) / (len(drawn) + num_kinds))
    if not is_measured:
        return log_share
    if num_same == 0:  # no simulation had these numbers
        return -math.inf
    return log_share + _log_density(drawn[same][:, own], observed[own])


def _log_density(drawn: Tensor, observed: Tensor, most_numbers: int = 8) -> float:
    """Return the log density; kernels say more of few numbers than a Gaussian does."""
    n, q = drawn.shape
    spread = Spread.of(drawn)
    log_density = spread.log_normal(observed)
    if n == 1 or q > most_numbers:
        return log_density
    root, width = spread.root(), silverman(n, q)
    apart = torch.linalg.solve_triangular(root, (drawn - observed).T, upper=False)
    gap = apart.square().sum(0) / width**2
    kernel = float((-0.5 * gap).logsumexp(0)) - math.log(n) - q * math.log(width)
    kernel -= float(root.diagonal().log().sum()) + 0.5 * q * math.log(2 * math.pi)
    return float(np.logaddexp(log_density, kernel)) - math.log(2)


@dataclass(frozen=True)
class Spread:
    r"""Mean and covariance of rows, the latter shrunk towards its diagonal.

    .. math::
        C = (1 - \lambda) \hat C + \lambda \operatorname{diag} \hat C,

    with the :math:`\lambda` of the largest leave-one-out Gaussian likelihood, so that C
    can be used with more numbers than rows. Missing numbers count as the mean. No
    result depends on the order of the rows.

    Attributes:
        mean: Means, shape (q,).
        scale: Standard deviations, shape (q,).
        share: :math:`\lambda`.
        z: Standardized rows, zero if not measured, shape (n, q).
        distance: Squared Mahalanobis distance of each row, shape (n,).

    References:
        Hoffbeck & Landgrebe, IEEE PAMI 1996 (leave-one-out shrinkage).
    """

    mean: Tensor
    scale: Tensor
    share: float
    z: Tensor
    distance: Tensor

    @staticmethod
    def of(rows: Tensor) -> Spread:
        """Return the spread of rows (n, q), float64, NaN where not measured."""
        present = rows.isfinite()
        count = present.sum(0).clamp_min(1)
        mean = rows.nansum(0) / count
        gap = torch.where(present, rows - mean, 0.0)
        variance = gap.square().sum(0) / count
        # What varies by rounding alone has no scale of its own.
        varies = variance > FLOOR * mean.square()
        floor = torch.where(varies, variance, variance.max()).clamp_min(1e-30)
        scale = (variance + FLOOR * floor).sqrt()
        z = gap / scale
        share, distance = _shrunk(z)
        return Spread(mean, scale, share, z, distance)

    def root(self) -> Tensor:
        """Return the lower Cholesky factor of C, shape (q, q)."""
        covariance = (1 - self.share) * self.z.T @ self.z / len(self.z)
        diagonal = torch.full_like(self.scale, self.share).diag()
        return self.scale[:, None] * torch.linalg.cholesky(covariance + diagonal)

    def log_normal(self, x: Tensor) -> float:
        """Return the log density of N(mean, C) at x, shape (q,)."""
        n, q = self.z.shape
        if q > n:  # from products of rows, of which there are fewer than numbers
            factor = (((1 - self.share) / n) ** 0.5 * self.z * self.scale).T
            rest = self.share * self.scale.square()
            return float(LowRankMultivariateNormal(self.mean, factor, rest).log_prob(x))
        root, off = self.root(), (x - self.mean)[:, None]
        z = torch.linalg.solve_triangular(root, off, upper=False)
        log_density = -0.5 * z.square().sum() - root.diagonal().log().sum()
        return float(log_density) - 0.5 * q * math.log(2 * math.pi)


def _shrunk(z: Tensor) -> tuple[float, Tensor]:
    r"""Return the share of the diagonal and each row's squared distance with it.

    Without row i the sample covariance about the same mean is

    .. math:: \hat C_{-i} = (n \hat C - z_i z_i^\top) / (n - 1).

    With :math:`G = (1 - \lambda) n / (n - 1) \hat C + \lambda I`,
    :math:`d_i = z_i^\top G^{-1} z_i` and :math:`b = (1 - \lambda) / (n - 1)`, the
    shrunk covariance without row i has the determinant :math:`|G| (1 - b d_i)`, and row
    i the squared distance :math:`d_i / (1 - b d_i)` by it.
    """
    n, q = z.shape
    if q <= n:
        value, vector = torch.linalg.eigh(z.T @ z / n)
        square = (z @ vector).square()
    else:  # the same from the smaller matrix of products of rows
        value, vector = torch.linalg.eigh(z @ z.T / n)
        square = n * vector.square() * value.clamp_min(0)
    value = value.clamp_min(0)[:, None]
    others = max(n - 1, 1)
    left = (1 - SHARES) * value * (n / others) + SHARES
    distance = square @ (1 / left)
    log_det = left.log().sum(0) + (q - len(value)) * SHARES.log()
    kept = (1 - (1 - SHARES) / others * distance).clamp_min(1e-12)
    loss = log_det + (kept.log() + distance / kept).mean(0)
    share = SHARES[int(loss.argmin())]
    return float(share), square @ (1 / ((1 - share) * value[:, 0] + share))
