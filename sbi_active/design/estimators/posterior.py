"""Variational lower bounds: a learned posterior, or one fitted to each candidate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from sklearn.preprocessing import QuantileTransformer
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.estimators.densities import (
    Reduction,
    by_pattern,
    cross_fit,
)
from sbi_active.design.estimators.emulator import linear
from sbi_active.design.estimators.entropy import nearest_neighbor_entropy
from sbi_active.inference.sampling.mixtures import fitted_normals
from sbi_active.seeding import forked_generators


class PosteriorGain(InformationGainEstimator):
    r"""Barber-Agakov bound, the utility of ASBI.

    .. math::
        U(\xi) = \frac{1}{M} \sum_{i=1}^M
        \log q(\theta_i | x_i, \xi) - \log p(\theta_i)
        \qquad \text{(Eqs. 12-13)}

    with :math:`\theta_i \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. For any q,
    :math:`E[U(\xi)] = I(\theta; x | \xi) - E[\mathrm{KL}(p(\theta | x, \xi) \| q)]`,
    so on simulations that q was not trained on it is a lower bound. Its slack differs
    by action: ranking by it is not ranking by information where q is blunter for one
    action than for another. Outcomes at the same parameters are averaged, as they are
    not independent.

    The model has ``log_posterior(theta, x, action)``, the log density of every row,
    shape (n,).

    References:
        Kim & Matsubara, Applied Intelligence 2025; Barber & Agakov, NeurIPS 2003.
    """

    bound: Bound = "lower"
    batch_size: int = 50_000  # rows in one pass of the network

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        density = getattr(belief, "smooth_log_prob", belief.log_prob)
        log_p = density(simulations.theta)
        theta, action = simulations.rows()
        gains = []
        for x in simulations.outcomes():
            rows = theta, x.flatten(0, 1), action
            batches = zip(*(part.split(self.batch_size) for part in rows), strict=True)
            log_q = torch.cat([model.log_posterior(*batch) for batch in batches])
            gains.append(log_q.reshape(x.shape[:2]) - log_p)
        return torch.stack(gains).mean(0)


class ParameterGain(InformationGainEstimator):
    r"""Barber-Agakov bound for a subset S of the parameters.

    .. math::
        I(\theta_S; x | \xi) \ge
        E \left[ \log q(u | x, \xi) - \log \phi(u) \right]
        - \mathrm{KL}\left( p(u) \,\|\, \phi \right), \qquad
        u_j = \Phi^{-1}(F_j(\theta_{S_j}))

    The other parameters are marginalized by drawing them with the rest. Information
    does not change under a monotone map of each parameter, here to about the standard
    normal :math:`\phi` by a thousand quantiles. What p(u) still differs from it by,
    such as the dependence of several parameters in the belief, comes from the
    nearest-neighbor entropy of 20 000 draws of the belief, which cost no simulations;
    its standard error, about .01 nat, is common to all candidates and not in theirs.

    q is a Gaussian around a regression or a Gaussian mixture, fitted for each candidate
    to three quarters of the simulations, the rest scored, in turn; which kind scores a
    quarter is chosen on the others. Invalid outcomes count: q conditions on which
    numbers of x are present.

    Args:
        target: Function of parameters (n, d) that gives theta_S or numbers that stand
            for it, (n, k); None are all.
        num_marginal: Number of draws of the belief for the marginal of the target; of a
            tenth its entropy has an error of .03 nat, common to all candidates.
        few: Outcomes of one pattern whose numbers are not used.

    References:
        Barber & Agakov, NeurIPS 2003; Foster et al., NeurIPS 2019 (variational bounds
        of the expected information gain).
    """

    bound: Bound = "lower"
    needs_model = False

    def __init__(
        self,
        target: Callable[[Tensor], Tensor] | None = None,
        *,
        num_marginal: int = 20_000,
        few: int = 24,
    ) -> None:
        self.target = target or (lambda theta: theta)
        self.num_marginal, self.few = num_marginal, few
        self._marginal: tuple[Distribution, QuantileTransformer, float] | None = None

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        if self._marginal is None or self._marginal[0] is not belief:
            with forked_generators(0, "marginal"):
                draws = belief.sample(torch.Size([self.num_marginal]))
            draws = self.target(draws).double().numpy()
            scores = QuantileTransformer(
                n_quantiles=min(1_000, len(draws)),
                output_distribution="normal",
                subsample=len(draws),
            )
            u = torch.from_numpy(scores.fit_transform(draws))
            self._marginal = belief, scores, _dependence(u)
        _, scores, dependence = self._marginal
        theta = self.target(simulations.theta).double().numpy()
        u = torch.from_numpy(scores.transform(theta))
        shape = simulations.x.shape[:2]
        gain = torch.full(shape, torch.nan, dtype=torch.float64)
        for a, rows, _, x in by_pattern(simulations, self.few):
            if len(rows) < 8:  # no density to fit: nothing is learned
                gain[a, rows] = -dependence
                continue
            gain[a, rows] = _score(u[rows], x) - log_normal(u[rows]) - dependence
        return gain


def _score(u: Tensor, x: Tensor) -> Tensor:
    def score(train: Tensor, test: Tensor) -> Tensor:
        members = conditional_members(u[train], x[train])
        log_q = [log_normal(u[test])]
        log_q += [member(u[test], x[test]) for member in members]
        return torch.stack(log_q)

    return cross_fit(score, torch.arange(len(u)), torch.ones(len(u)))


def _dependence(u: Tensor, num_neighbors: int = 4) -> float:
    """Divergence of p(u) from the standard normal, nats, from draws (m, s)."""
    entropy = float(nearest_neighbor_entropy(u, num_neighbors).mean())
    return max(0.0, -float(log_normal(u).mean()) - entropy)


LOG_2PI = math.log(2 * math.pi)
#: Powers of ten, of which the left-out rows choose one.
RIDGES = 10.0 ** torch.arange(-6.0, 3.0, dtype=torch.float64)

Density = Callable[[Tensor, Tensor], Tensor]
Features = Callable[[Tensor], Tensor]


def conditional_members(u: Tensor, x: Tensor, num_knots: int = 100) -> list[Density]:
    """Fit conditional densities of u (n, s), close to standard normal, given x (n, q).

    The order is: Gaussians around a quadratic and a radial regression, whose covariance
    is scaled by a log-quadratic function of x; a mixture of Gaussians of (u, x),
    conditioned on x. Each has a share of the standard normal, so that no row costs more
    than a few nats. They are functions of u (k, s) and x (k, q), which may have no
    numbers, -> (k,). On twelve problems a linear regression, and constant covariances,
    added less than .04 nat.
    """
    if x.shape[1] == 0:
        return [_defended(_mixture(u, x, lambda x: x))]
    reduce = Reduction.fit(x, torch.cat([u, u.square()], 1))

    def quadratic(x: Tensor) -> Tensor:
        z = reduce(x)
        i, j = torch.triu_indices(z.shape[1], z.shape[1])
        return torch.cat([z, z[:, i] * z[:, j]], 1).clamp(-30, 30)

    knots = reduce(x[:num_knots])

    def radial(x: Tensor) -> Tensor:
        z = reduce(x)
        return torch.cat([z, (-torch.cdist(z, knots)).exp()], 1)

    members = [_around(u, x, features, quadratic) for features in (quadratic, radial)]
    return [_defended(member) for member in [*members, _mixture(u, x, reduce)]]


def log_normal(u: Tensor) -> Tensor:
    """Log density of the standard normal, (n, s) -> (n,)."""
    return -0.5 * (u.square() + LOG_2PI).sum(-1)


def _defended(member: Density, share: float = 0.02) -> Density:
    return lambda u, x: torch.logaddexp(
        member(u, x) + math.log(1 - share), log_normal(u) + math.log(share)
    )


def _around(u: Tensor, x: Tensor, mean: Features, spread: Features) -> Density:
    r"""Return the density :math:`u \sim N(\mu(x), s^2(x) L L^\top)`.

    Args:
        u: Values that it is fitted to, shape (n, s).
        x: Outcomes, shape (n, q).
        mean: Features that :math:`\mu` is linear in.
        spread: Features that :math:`\log s` is linear in.
    """
    n, s = u.shape
    slope, residual = _ridge(mean(x), u)
    location = residual.mean(0)
    centered = residual - location
    factor = torch.linalg.cholesky(centered.T @ centered / n + 1e-10 * torch.eye(s))
    log_det = factor.diagonal().log().sum()

    def whitened(centered: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(factor, centered.T, upper=False)

    log_square = (whitened(centered).square().mean(0) + 1e-3).log()
    growth, _ = _ridge(spread(x), log_square[:, None])

    def log_scale(x: Tensor) -> Tensor:
        return (0.5 * (linear(spread(x)) @ growth)[:, 0]).clamp(-6, 6)

    square = whitened(centered).square() / (2 * log_scale(x)).exp()
    offset = 0.5 * float(square.mean().log())

    def log_density(u: Tensor, x: Tensor) -> Tensor:
        width = log_scale(x) + offset
        white = whitened(u - linear(mean(x)) @ slope - location)
        square = white.square().sum(0) / (2 * width).exp()
        return -0.5 * (square + s * (LOG_2PI + 2 * width)) - log_det

    return log_density


def _ridge(features: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes with intercept (1 + p, s), leave-one-out residuals, at the best ridge."""
    center, middle = features.mean(0), u.mean(0)
    left, value, right = torch.linalg.svd(features - center, full_matrices=False)
    rotated = left.T @ (u - middle)
    fits = []
    for ridge in RIDGES * len(u):
        shrink = value.square() / (value.square() + ridge)
        leverage = left.square() @ shrink + 1 / len(u)
        residual = u - middle - left @ (shrink[:, None] * rotated)
        residual = residual / (1 - leverage).clamp_min(1e-6)[:, None]
        score = float(residual.square().mean(0).log().sum())
        per_value = value / (value.square() + ridge)
        fits.append((score, right.T @ (per_value[:, None] * rotated), residual))
    _, slope, residual = min(fits, key=lambda fit: fit[0])
    return torch.cat([(middle - center @ slope)[None], slope]), residual


def _mixture(u: Tensor, x: Tensor, reduce: Features, most: int = 6) -> Density:
    """Return the conditional density of a mixture of so many Gaussians of (z, u)."""
    z = reduce(x)
    q, rows = z.shape[1], torch.cat([z, u], 1).numpy()
    joint = fitted_normals(rows, most, np.random.default_rng(0), num_iterations=40)
    given = replace(joint, means=joint.means[:, :q], factors=joint.factors[:, :q, :q])

    def log_density(u: Tensor, x: Tensor) -> Tensor:
        rows = torch.cat([reduce(x), u], 1).numpy()
        log_q = joint.log_prob(rows)
        return torch.from_numpy(log_q - given.log_prob(rows[:, :q]) if q else log_q)

    return log_density
