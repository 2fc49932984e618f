r"""Surfaces of the likelihood, which say of a draw whether it is worth a simulation.

Near a posterior the residuals of a smooth simulator are nearly polynomials of its
parameters,

.. math::
    \hat r(u) = B f(u), \qquad \log \hat L(u) = c - \tfrac12 \| \hat r(u) \|^2 ,

with f all products of coordinates up to a degree. A draw of a proposal g passes with
probability

.. math::
    a(u) = \max\bigl(\epsilon, \min(1, p(u) \hat L(u) / (t\, g(u)))\bigr),

and the others are not simulated. What passes is drawn from

.. math::
    q(u) = g(u)\, a(u) / A, \qquad A = \mathbb{E}_g[a],

so that its weights are right whatever the surface is: one that is wrong leaves uneven
weights, and where it sees nothing a share of the draws passes all the same.

References:
    Liu, Chen & Wong, Journal of the American Statistical Association 93 (1998), on
    rejection control.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from sbi_active.arrays import Array
from sbi_active.inference.engine.pool import Pool
from sbi_active.inference.engine.potential import Density, Potential
from sbi_active.inference.engine.settings import SurfaceSettings
from sbi_active.inference.sampling.least_squares import Whitener
from sbi_active.inference.sampling.mixtures import Proposal, lower_factors
from sbi_active.inference.sampling.weights import log_sum_exp, normalized


@dataclass(frozen=True)
class Surface:
    """The likelihood of residuals that are polynomials of the coordinates.

    Attributes:
        center: Middle of the places that it was fitted to, shape (d,).
        inverse: Inverse of a factor of their covariance, shape (d, d).
        degree: Degree of the polynomials.
        root: Matrix whose products with features are as long as the residuals, shape
            (k, m).
        constant: Log likelihood of residuals that vanish.
        efficiency: Share of draws of its posterior that are effective draws of the
            posterior, by places that had no part in a fit.
    """

    center: Array
    inverse: Array
    degree: int
    root: Array
    constant: float
    efficiency: float

    def log_likelihood(self, u: Array, *, most: int = 1_000_000) -> Array:
        """Return log likelihoods, shape (n,).

        Args:
            u: Places, shape (n, d).
            most: Number of features that are computed at once, 8 MB.
        """
        num = 1 + len(u) * self.root.shape[1] // most
        return np.concatenate([self._at(block) for block in np.array_split(u, num)])

    def _at(self, u: Array) -> Array:
        z = (u - self.center) @ self.inverse.T
        residual = features(z, self.degree) @ self.root.T
        return self.constant - 0.5 * (residual**2).sum(1)


def features(z: Array, degree: int) -> Array:
    """Return all products of at most so many coordinates, (n, d) -> (n, m)."""
    parts = [np.ones((len(z), 1))]
    products = {(): np.ones(len(z))}
    for _ in range(degree):
        products = {
            (*factors, j): product * z[:, j]
            for factors, product in products.items()
            for j in range(factors[-1] if factors else 0, z.shape[1])
        }
        parts.append(np.stack([*products.values()], axis=1))
    return np.concatenate(parts, axis=1)


def fitted_surface(
    potential: Potential,
    whiten: Whitener,
    pool: Pool,
    rng: np.random.Generator,
    settings: SurfaceSettings,
) -> Surface | None:
    """Return the surface of a pool's draws, of the degree that predicts them best.

    Each fifth of the draws is predicted by a fit to the others.

    Args:
        potential: Potential, whose residuals are known where the draws are.
        whiten: Whitener of the residuals by the likeliest error.
        pool: Draws so far.
        rng: Source of the choice of draws.
        settings: Settings of the fit.

    Returns:
        None if draws are few, or have residuals without a number.
    """
    own, dim = settings, pool.u.shape[1]
    log_target = pool.log_prior + pool.log_likelihood
    depth = log_target.max() - log_target
    rows = np.flatnonzero(depth < own.depth)
    degrees = [
        degree
        for degree in range(1, own.most_degree + 1)
        if comb(dim + degree, degree) <= own.most_features
        and comb(dim + degree, degree) * own.fewest <= len(rows)
    ]
    if not degrees:
        return None
    enough = own.plenty * comb(dim + degrees[-1], degrees[-1])
    if len(rows) > enough:
        rows = np.sort(rng.choice(rows, enough, replace=False))
    u, log_likelihood = pool.u[rows], pool.log_likelihood[rows]
    residual = whiten(potential.residual(u)[0])
    if not np.isfinite(residual).all():
        return None
    # Far from the posterior a response need not be a polynomial of so low a degree.
    scale = np.exp(-0.5 * own.temper * depth[rows])[:, None]
    constant = float(np.median(log_likelihood + 0.5 * (residual**2).sum(1)))
    center = u.mean(0)
    inverse = np.linalg.inv(lower_factors(np.atleast_2d(np.cov(u.T))))
    z = (u - center) @ inverse.T
    log_rest = (pool.log_prior - pool.log_mixture)[rows]
    fold = rng.permutation(len(u)) % own.num_folds

    def efficiency(f: Array) -> float:
        predicted = np.empty_like(residual)
        for k in range(own.num_folds):
            fit = fold != k
            slopes = _solved(f[fit], residual[fit], scale[fit])
            predicted[~fit] = f[~fit] @ slopes
        learned = constant - 0.5 * (predicted**2).sum(1)
        weight = normalized(log_rest + learned)
        ratio = log_likelihood - learned
        ratio = np.exp(np.clip(ratio - weight @ ratio, -50.0, 50.0))
        return float((weight @ ratio) ** 2 / (weight @ ratio**2))

    candidates = [(efficiency(features(z, degree)), degree) for degree in degrees]
    most = max(candidates)[0]  # a lower degree that is as good costs less
    best, degree = next(pair for pair in candidates if pair[0] >= 0.99 * most)
    slopes = _solved(features(z, degree), residual, scale)
    root = np.asarray(np.linalg.qr(slopes.T, mode="r"))
    return Surface(center, inverse, degree, root, constant, best)


def _solved(f: Array, residual: Array, scale: Array) -> Array:
    """Return slopes of residuals along features, shape (m, N), of weighted rows."""
    return np.linalg.lstsq(scale * f, scale * residual, rcond=1e-10)[0]


class SurfacePotential:
    """The prior times the likelihood of a surface, which simulates nothing.

    Args:
        potential: Potential that knows the prior.
        surface: Surface of its likelihood.
    """

    num_trials, num_simulations = 1, 0

    def __init__(self, potential: Density, surface: Surface) -> None:
        self.potential, self.surface, self.dim = potential, surface, potential.dim

    def sample_prior(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (n, d)."""
        return self.potential.sample_prior(num, rng)

    def simulated(self, u: Array) -> Array:
        """Return the places within the prior's support, shape (k, d)."""
        return self.potential.simulated(u)

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        return self.potential.log_prior(u)

    def log_likelihood(self, u: Array, *, floor: float | Array = -np.inf) -> Array:
        """Return the surface's log likelihoods, shape (n,)."""
        return self.surface.log_likelihood(u)

    def reweighted(self, pool: Pool) -> Pool:
        """Return a pool's draws with the surface's likelihood."""
        num = len(pool.u)
        return replace(
            pool,
            log_likelihood=self.log_likelihood(pool.u),
            is_final=np.zeros(num, dtype=bool),
            num_final=0,
            proposals=[*pool.proposals],
            final=None,
        )


@dataclass(frozen=True)
class Screened(Proposal):
    """Draws of a proposal that a surface lets pass.

    Attributes:
        base: Proposal.
        target: Prior times likelihood of the surface.
        log_level: Log weight from which on every draw passes.
        floor: Least probability to pass.
        log_mass: Log of the share that passes.
        error: Standard error of log_mass, nats.
        efficiency: Share of what passes that is expected to be effective.
    """

    base: Proposal
    target: SurfacePotential
    log_level: float = np.inf
    floor: float = 1.0
    log_mass: float = 0.0
    error: float = 0.0
    efficiency: float = 0.0

    def log_passed(self, z: Array) -> Array:
        """Return log probabilities to pass, shape (n,)."""
        log_weight = self._log_weight(z)
        return np.clip(log_weight - self.log_level, np.log(self.floor), 0.0)

    def _log_weight(self, z: Array) -> Array:
        target = self.target
        return target.log_prior(z) + target.log_likelihood(z) - self.base.log_prob(z)

    def sample(
        self, num_samples: int, rng: np.random.Generator, *, most: int = 50_000
    ) -> Array:
        """Return draws, shape (n, d); so many at most are screened at a time."""
        parts, left = [np.empty((0, self.target.dim))], num_samples
        while left > 0:
            size = int(min(1.1 * left / np.exp(self.log_mass) + 10, most))
            z = rng.permutation(self.base.sample(size, rng))
            passed = z[np.log(rng.random(size)) < self.log_passed(z)][:left]
            parts.append(passed)
            left -= len(passed)
        return np.concatenate(parts)

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        return self.base.log_prob(z) + self.log_passed(z) - self.log_mass

    def leveled(self, rng: np.random.Generator, settings: SurfaceSettings) -> Screened:
        """Return it with the least level that makes what passes efficient.

        Args:
            rng: Source of the draws that tell its mass.
            settings: Settings of the level.
        """
        own = settings
        log_weight = self._log_weight(self.base.sample(own.num_screened, rng))
        levels = np.quantile(log_weight[np.isfinite(log_weight)], own.levels)

        def efficiency(level: float) -> float:
            """Return the share of what passes that is effective."""
            passed = np.minimum(log_weight - level, 0.0)
            rest = np.maximum(log_weight - level, 0.0)
            square = log_sum_exp(passed) + log_sum_exp(passed + 2 * rest)
            return float(np.exp(2 * log_sum_exp(passed + rest) - square))

        def mass(level: float) -> float:
            return float(np.exp(np.minimum(log_weight - level, 0.0)).mean())

        allowed = [v for v in levels if mass(v) >= own.least_mass] or [levels[0]]
        level = next((v for v in allowed if efficiency(v) >= own.even), allowed[-1])
        floor = own.unscreened * mass(level)
        passed = np.clip(np.exp(np.minimum(log_weight - level, 0.0)), floor, 1.0)
        share = float(passed.mean())
        error = float(passed.std() / share / len(passed) ** 0.5)
        return replace(
            self,
            log_level=level,
            floor=floor,
            log_mass=float(np.log(share)),
            error=error,
            efficiency=efficiency(level) * self.target.surface.efficiency,
        )
