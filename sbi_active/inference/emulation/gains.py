r"""What each action would tell, by one regression over parameters and actions.

Few simulations of each action suffice where what is learned of one serves the others.
The noise of a simulator that is itself random is learned by action,

.. math::
    \tau_\xi^2 = \frac{\nu \tau^2 + \sum_{i \in \xi} r_i^2}{\nu + n_\xi},

from the residuals r of left-out rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.emulation.emulator import interpolated, nearest_rows
from sbi_active.inference.emulation.outcomes import (
    Summary,
    is_short,
    learned_statistic,
)
from sbi_active.inference.emulation.pool import Pool
from sbi_active.inference.emulation.solving import around
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.gaussian_process import GaussianProcess
from sbi_active.seeding import derive_seed
from sbi_active.simulation.noise.base import NoiseModel


def candidate_gains(
    pool: Pool,
    reference: Array,
    candidates: Tensor,
    summaries: Sequence[Summary],
    noise: NoiseModel | None,
    coordinates: PriorCoordinates,
    *,
    seed: int,
    most_rows: int = 600,
    num_outer: int = 160,
    num_inner: int = 1_000,
) -> tuple[Array, Array]:
    """Return contributions to the gain and the share of measurements.

    All actions and summaries are compared at the same parameters, with the same noise,
    from the same raw rows.

    Args:
        pool: Pool of raw simulations.
        reference: Coordinates of draws from the belief, shape (n, d).
        candidates: Simulated actions, shape (a, action_dim).
        summaries: K of them.
        noise: Declared noise, or None.
        coordinates: Coordinates of the prior.
        seed: Seed of the outcomes.
        most_rows: Number of rows, those nearest to the belief, that the processes rest
            on.
        num_outer: Number m of parameters that outcomes are drawn at.
        num_inner: Number of further parameters that each is compared with.

    Returns:
        Shapes (a, K, m), nats, and (a,).
    """
    rows = pool.rows
    z, action = coordinates.to_z(rows.theta), rows.action.double().numpy()
    region = around(reference)
    near = np.sort(nearest_rows(region, z, most_rows))
    region = region.sized(z[near])
    rng = np.random.default_rng(derive_seed(seed, "outcomes"))
    draws = reference[rng.integers(len(reference), size=num_outer + num_inner)]
    draws, z, action = region.scaled(draws), z[near], action[near]
    places = candidates.double().numpy()
    center, scale = places.mean(0), places.std(0)
    varied = scale > 0
    place, unit = (
        ((own - center) / (scale + ~varied))[:, varied] for own in (action, places)
    )
    inputs = np.concatenate([region.scaled(z), place], 1)
    same = np.abs(action[:, None] - places).max(2) < 1e-5
    raw = rows.x[torch.from_numpy(near)]
    measured = raw.flatten(1).isfinite().any(1).numpy()
    count, found = same.sum(0), (same & measured[:, None]).sum(0)
    valid = (found + measured.mean()) / (count + 1)
    gains = np.zeros((len(places), len(summaries), num_outer))
    for k, summary in enumerate(summaries):
        numbers, rng = summary(raw), np.random.default_rng(derive_seed(seed, "noise"))
        full = np.isfinite(numbers).all(1)
        if full.sum() < z.shape[1] + 4:
            continue
        own_rows = inputs[full], z[full], numbers[full], same[full]
        processes, roots = _learned(*own_rows, noise, raw.shape[1:], rng, seed)
        normal = rng.standard_normal((num_outer, len(roots[0])))
        for a, own in enumerate(unit):
            tiled = np.broadcast_to(own, (len(draws), len(own)))
            at = np.concatenate([draws, tiled], 1)
            parts = [process.predict(at) for process in processes]
            mean, variance = (np.concatenate(p, 1) for p in zip(*parts, strict=True))
            inverse = np.linalg.inv(roots[a])
            spread = 1 + variance @ (inverse**2).T
            gains[a, k] = mixture_gain(mean @ inverse.T, spread, normal)
    return gains * valid[:, None, None], valid


def _learned(
    inputs: Array,
    z: Array,
    numbers: Array,
    same: NDArray[np.bool_],
    noise: NoiseModel | None,
    x_shape: Sequence[int],
    rng: np.random.Generator,
    seed: int,
    *,
    own_rows: float = 8.0,
) -> tuple[tuple[GaussianProcess, ...], list[Array]]:
    """Return processes of numbers (n, q) and a factor of each action's noise.

    Actions share the noise of ``own_rows`` rows beside those of their own.
    """
    if noise is not None:
        processes = (interpolated(inputs, numbers, ("rough",)),)
        zeros = torch.zeros(max(400, 4 * numbers.shape[1]), *x_shape).double()
        seeds = torch.from_numpy(rng.integers(2**62, size=len(zeros)))
        sampled = noise.sample(zeros, seeds).reshape(len(zeros), -1).numpy()
        covariance = np.atleast_2d(np.cov(sampled.T))
        root = np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)))
        return processes, [root] * same.shape[1]
    dim, features = z.shape[1], numbers
    if not is_short(numbers.shape[1], dim) and inputs.shape[1] > dim:
        crossed = [numbers * inputs[:, [j]] for j in range(dim, inputs.shape[1])]
        features = np.concatenate([numbers, *crossed, inputs[:, dim:]], 1)
    _, own = learned_statistic(features, z, seed=derive_seed(seed, "folds"))
    processes = tuple(
        GaussianProcess.fit(inputs, column[:, None], noise="learned")
        for column in own.T
    )
    left_out = np.concatenate([process.left_out for process in processes], 1)
    common = np.concatenate([p.noise_sd for p in processes]) ** 2
    total = own_rows * common + same.T.astype(float) @ left_out**2
    sd = np.sqrt(total / (own_rows + same.sum(0))[:, None])
    root = correlation_root(left_out)
    return processes, [s[:, None] * root for s in sd]


def correlation_root(residual: Array, shrinkage: float = 10.0) -> Array:
    """Return the Cholesky factor of the correlation of residuals (n, q), shrunk.

    Args:
        residual: Residuals.
        shrinkage: Number of rows that independence counts for.
    """
    n, q = residual.shape
    unit = residual / np.maximum(np.sqrt((residual**2).mean(0)), 1e-30)
    correlation = (unit.T @ unit + shrinkage * np.eye(q)) / (n + shrinkage)
    return np.linalg.cholesky(correlation)


def mixture_gain(mean: Array, spread: Array, normal: Array) -> Array:
    r"""Return contributions to the information of the first parameters, (k,).

    .. math::
        I = \mathrm E\left[\log p(x_i | \theta_i) - \log \frac{1}{M + 1}
        \sum_{j = 0}^M p(x_i | \theta_j)\right], \qquad \theta_0 = \theta_i,

    which is at most log(M + 1) (Foster et al., AISTATS 2020).

    Args:
        mean: Mean outcomes at the parameters in units of the noise, shape (m, q).
        spread: Variance of these with that of the noise, shape (m, q) or (m, 1).
        normal: Standard normal numbers of the first parameters, shape (k, q).
    """
    num_outer = len(normal)
    # Where simulations are few is no property of the outcome: one variance for all.
    v = spread.mean(0) + 0 * mean
    x = mean[:num_outer] + np.sqrt(v[:num_outer]) * normal
    own = -0.5 * (normal**2 + np.log(v[:num_outer])).sum(1)
    log_volume = 0.5 * np.log(v).sum(1)
    # (x - m)^2 / v summed over numbers, as products of matrices
    square = (x**2) @ (1 / v).T - 2 * x @ (mean / v).T + ((mean**2) / v).sum(1)
    every = -0.5 * square - log_volume
    keep = np.concatenate([every[:, num_outer:], own[:, None]], 1)
    return own - (logsumexp(keep, 1) - np.log(keep.shape[1]))
