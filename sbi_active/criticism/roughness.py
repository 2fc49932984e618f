"""What a search and a sampler need where the simulator jumps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.criticism.errors import NoiseGrid, log_sum_exp
from sbi_active.criticism.importance import ImportanceSample, TMixture
from sbi_active.criticism.least_squares import find_modes, local_proposal
from sbi_active.criticism.rival import Rival

__all__ = ["by_regression", "local_roughness"]

Array = NDArray[Any]

#: Draws a coefficient of the local regression, and draws at least.
PER_COEFFICIENT, FEWEST_DRAWS = 3, 64
#: Each round looks as far around the mode as the noise found by the one before says.
ROUNDS = 2
#: Median absolute deviation of a normal variable of unit variance.
MEDIAN = 0.6745
#: Draws from a regression, rounds of them, components that stand for them in a
#: proposal, its power of the likelihood, and the share of a normal cloud of rows
#: within which a regression is believed.
NUM_DRAWS, NUM_ADAPTED, NUM_COMPONENTS, POWER, WITHIN = 2_000, 4, 40, 0.6, 0.999


def local_roughness(rival: Rival, noise: NoiseGrid, *, step: float, seed: int) -> Array:
    r"""Return the standard deviation of what no smooth function follows, shape (N,).

    A simulator of contact or chaos answers a change of its parameters that is far
    within their posterior by a jump. Beside the error of measurement s, jumps of size r
    change the log likelihood of N numbers by about :math:`N (r / s)^2`, and its peaks
    are those of the jumps. Taken as an independent error of deviation r, as a nugget is
    in the emulation of computer codes, they leave a likelihood that a search can climb
    and importance sampling can integrate; it claims less than the simulator would, had
    one the draws to resolve it.

    r is estimated from the residuals of a quadratic regression on draws around the best
    fit, as wide as the posterior there, by their median absolute deviation.

    Args:
        rival: The bare model, with the declared noise.
        noise: The same noise.
        step: Of finite differences.
        seed: Of the draws.

    References:
        Gramacy & Lee, Statistics and Computing 22 (2012), for the nugget of
        deterministic codes; Kennedy & O'Hagan, J. R. Stat. Soc. B 63 (2001).
    """
    modes = find_modes(rival, step=step, seed=seed)
    rng = np.random.default_rng(seed)
    dim, c = rival.dim, rival.coordinates
    num = max(PER_COEFFICIENT * (dim + 1) * (dim + 2) // 2, FEWEST_DRAWS)
    rough = np.zeros(len(rival.simulator.measurements))
    for _ in range(ROUNDS):
        wide = noise.with_extra(rough)
        whiten = wide.whitener(rival.residual(modes.u[:1])[0][0])
        u = local_proposal(rival, modes.u[:1], whiten, step).sample(num, rng)
        u = np.clip(u, c.low, c.high)
        mean, _, _ = rival.simulator.predict(*c.split(u))
        rough = _beside_quadratic(u - modes.u[0], mean)
    return rough


def by_regression(
    rival: Rival, sample: ImportanceSample, rng: np.random.Generator
) -> TMixture:
    """Return a proposal from a quadratic regression of the residuals.

    Derivatives of a simulator that jumps, of which a search makes its proposal, are
    those of the jumps, while a regression on what was simulated so far averages over
    them. It serves to propose alone: the weights are the simulator's.

    Args:
        rival: The model.
        sample: Its particles so far, with their weights.
        rng: Source of the draws.
    """
    u, dim = sample.u, rival.dim
    target = rival.log_prior(u)
    inside = np.isfinite(target)
    u, target = u[inside], target[inside]
    target = target + rival.log_likelihood(u)
    num = (dim + 1) * (dim + 2) // 2
    weight = _tempered(target, min(PER_COEFFICIENT * num, 0.5 * len(u)))
    mean = weight @ u
    cov = ((u - mean) * weight[:, None]).T @ (u - mean) + 1e-12 * np.eye(dim)
    whiten = np.linalg.inv(np.linalg.cholesky(cov)).T
    root = np.sqrt(weight)[:, None]
    residual = rival.residual(u)[0]
    rows = _quadratic((u - mean) @ whiten)
    fit = np.linalg.lstsq(root * rows, root * residual, rcond=None)[0]
    farthest = chi2.ppf(WITHIN, dim)

    def log_posterior(at: Array) -> Array:
        z = (at - mean) @ whiten
        log_p = rival.log_prior(at)
        log_p = np.where((z**2).sum(1) < farthest, log_p, -np.inf)
        has = np.isfinite(log_p)
        log_p[has] += POWER * rival.error.log_likelihood(_quadratic(z[has]) @ fit)
        return log_p

    proposal = TMixture(mean[None], np.linalg.cholesky(cov)[None])
    for _ in range(NUM_ADAPTED):
        draws = proposal.sample(NUM_DRAWS, rng)
        log_w = log_posterior(draws) - proposal.log_prob(draws)
        if not np.isfinite(log_w).any():
            break
        w = np.exp(log_w - log_sum_exp(log_w))
        center = w @ draws
        cov = ((draws - center) * w[:, None]).T @ (draws - center)
        # Scott's width, of kernels whose mixture has the draws' covariance.
        width = NUM_COMPONENTS ** (-1 / (dim + 4))
        kernel = np.linalg.cholesky(width**2 * cov + 1e-12 * np.eye(dim))
        means = draws[rng.choice(len(draws), NUM_COMPONENTS, p=w)]
        proposal = TMixture(means, np.repeat(kernel[None], NUM_COMPONENTS, 0))
    return proposal


def _tempered(target: Array, effective: float) -> Array:
    """Return weights in proportion to a power of exp(target), so many effective."""
    finite = np.where(np.isfinite(target), target, -1e300)
    apart = finite - finite.max()
    low, high = 0.0, 1.0
    for _ in range(50):
        power = 0.5 * (low + high)
        w = np.exp(power * apart)
        if w.sum() ** 2 / (w**2).sum() < effective:
            high = power
        else:
            low = power
    w = np.exp(low * apart)
    return w / w.sum()


def _quadratic(z: Array) -> Array:
    """Return 1, z and all products of two, shape (n, (dim + 1) (dim + 2) / 2)."""
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, i] * z[:, j]], 1)


def _beside_quadratic(u: Array, x: Array) -> Array:
    """Return the deviation of x, shape (n, N), around a quadratic function of u."""
    dim = u.shape[1]
    scale = u.std(0)
    basis = _quadratic(u / np.where(scale > 0, scale, 1.0))
    found = np.zeros(x.shape[1])
    for k, column in enumerate(x.T):
        has = np.isfinite(column)
        freedom = int(has.sum()) - basis.shape[1]
        if freedom < dim:
            continue
        fit = np.linalg.lstsq(basis[has], column[has], rcond=None)[0]
        rest = np.abs(column[has] - basis[has] @ fit)
        lost = np.sqrt(has.sum() / freedom)
        found[k] = np.median(rest) / MEDIAN * lost
    return found
