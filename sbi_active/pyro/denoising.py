r"""NUTS over the errors of an outcome, and what the simulator would have given.

A channel may be right or wrong, two peaks of :math:`\log \sigma_c` between which no
chain goes, and which of them it is the other channels tell. Its coordinate is therefore
:math:`y_c = \Phi^{-1}(F_c(\sigma_c))` with :math:`F_c` about the marginal of its
posterior, on a grid. That is the mean, over Gibbs sweeps, of

.. math::
    p(\sigma_c | \sigma_{-c}, x_o) \propto p(\sigma_c) \sum_k
        w_k(\sigma_{-c})\, N(x_{o,c};\, m_{kc},\, v_{kc} + \sigma_c^2)

in which x and the components are summed out (Rao-Blackwell), with a share of what the
channel alone says to a power of .3, for the tails.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.sampling.mixtures import fitted_normals
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.pyro.error_models import ErrorModel
from sbi_active.seeding import forked_generators


@dataclass(frozen=True)
class Predictive:
    """A normal mixture.

    Attributes:
        log_weight: Log weights, shape (k,).
        mean: Means, shape (k, q).
        cov: Covariances, shape (k, q, q).
    """

    log_weight: Tensor
    mean: Tensor
    cov: Tensor

    @staticmethod
    def fit(x: Tensor, seed: int, *, num: int = 4) -> Predictive:
        """Return a fit to rows (n, q)."""
        rng = np.random.default_rng(seed)
        found = fitted_normals(x.numpy(), num, rng)
        parts = found.weights, found.means, found.factors
        weight, mean, factor = map(torch.from_numpy, parts)
        return Predictive(weight.log(), mean, factor @ factor.mT)

    def marginal(self, seen: Tensor) -> Predictive:
        """Return the predictive of some channels, a boolean of shape (q,)."""
        cov = self.cov[:, seen][:, :, seen]
        return Predictive(self.log_weight, self.mean[:, seen], cov)

    def log_joint(self, x_o: Tensor, sd: Tensor) -> Tensor:
        """Return log densities at x_o by component, (..., q) to (..., k)."""
        cov = self.cov + torch.diag_embed(sd**2)[..., None, :, :]
        root = torch.linalg.cholesky_ex(cov)[0]
        off = (x_o - self.mean)[..., None].expand(*root.shape[:-1], 1)
        off = torch.linalg.solve_triangular(root, off, upper=False)[..., 0]
        volume = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self.log_weight - 0.5 * off.square().sum(-1) - volume

    def log_alone(self, x_o: Tensor, sd: Tensor) -> Tensor:
        """Return log densities of each channel alone, (..., q) to (..., q)."""
        variance = self.cov.diagonal(dim1=-2, dim2=-1) + sd[..., None, :] ** 2
        square = (x_o - self.mean) ** 2 / variance
        log_p = self.log_weight[:, None] - 0.5 * (square + variance.log())
        return log_p.logsumexp(-2)

    def given(self, x_o: Tensor, sd: Tensor, seen: Tensor) -> Tensor:
        """Return a draw of x for each row of deviations, (n, seen) to (n, q)."""
        n, own = len(sd), self.marginal(seen)
        k = dist.Categorical(logits=own.log_joint(x_o, sd)).sample()
        root = torch.linalg.cholesky_ex(self.cov)[0]
        u = torch.randn(n, self.mean.shape[1], dtype=x_o.dtype)
        u = self.mean[k] + (root[k] @ u[..., None])[..., 0]
        # Matheron's rule: a draw, moved by what it misses of what was seen.
        missed = x_o - u[:, seen] - sd * torch.randn_like(sd)
        noisy = own.cov[k] + torch.diag_embed(sd**2)
        back = torch.linalg.solve(noisy, missed[..., None])
        return u + (self.cov[k][:, :, seen] @ back)[..., 0]


class Coordinates:
    """Log deviations as functions of coordinates that are about standard normal.

    Args:
        fit: Predictive of the channels that were seen.
        target: Outcome of these channels, shape (q,).
        error_model: Error model of the deviations.
        rng: Random generator of the Gibbs sweeps.
        tempered: Power of what a channel says alone.
        share: Share of that.
        lowest: Smallest deviation.
        num_grid: Number of deviations of the grid.
        reach: Largest coordinate.
        num_knots: Number of coordinates between which deviations are interpolated.
    """

    def __init__(
        self,
        fit: Predictive,
        target: Tensor,
        error_model: ErrorModel,
        rng: np.random.Generator,
        *,
        tempered: float = 0.3,
        share: float = 0.1,
        lowest: float = 1e-4,
        num_grid: int = 1_000,
        reach: float = 6.0,
        num_knots: int = 1_201,
    ) -> None:
        self._reach, self._fit, self._target = reach, fit, target
        highest = float(np.log(10 * float(target.abs().max()) + 100))
        self._low = float(np.log(lowest))
        self._step = (highest - self._low) / (num_grid - 1)
        grid = self._low + self._step * torch.arange(num_grid, dtype=target.dtype)
        log_prior = error_model.log_deviation(grid).numpy()
        log_alone = fit.log_alone(target, grid.exp()[:, None].expand(-1, len(target)))
        alone = tempered * log_alone.numpy().T
        alone = _normalized(alone, log_prior) + np.log(share)
        gibbs = _swept(fit, target, log_prior, grid.numpy(), rng) + np.log(1 - share)
        gain = np.logaddexp(alone, gibbs)  # density over the prior's, (q, grid)
        log_p = gain + log_prior
        p = np.exp(log_p - log_p.max(1, keepdims=True))
        area = 0.5 * (p[:, 1:] + p[:, :-1])
        cdf = np.concatenate([np.zeros((len(p), 1)), area.cumsum(1)], 1)
        cdf = cdf / cdf[:, -1:]
        y = torch.linspace(-reach, reach, num_knots, dtype=target.dtype)
        levels = torch.special.ndtr(y).numpy()
        # Where nothing is likely the distribution is flat, and has no inverse.
        rising = np.arange(num_grid) * 1e-15
        points = grid.numpy()
        knots = [np.interp(levels, row + rising, points) for row in cdf]
        self._knots = torch.from_numpy(np.stack(knots, 1))
        self._gain = torch.from_numpy(np.ascontiguousarray(gain.T))

    def __call__(self, y: Tensor) -> Tensor:
        """Return log deviations, (..., q) to (..., q)."""
        place = (y + self._reach) * ((len(self._knots) - 1) / (2 * self._reach))
        return _between(self._knots, place)

    def log_gain(self, log_sd: Tensor) -> Tensor:
        """Return the log density behind y over the prior's, (..., q) to (..., q)."""
        return _between(self._gain, (log_sd - self._low) / self._step)

    def potential(self, sites: dict[str, Tensor]) -> Tensor:
        """Return minus the log density of coordinates, the site "y"."""
        y, log_sd = sites["y"], self(sites["y"])
        joint = self._fit.log_joint(self._target, log_sd.exp()).logsumexp(-1)
        return 0.5 * y.square().sum(-1) - joint + self.log_gain(log_sd).sum(-1)


def _between(table: Tensor, place: Tensor) -> Tensor:
    """Return a table's columns (n, q) at places between its rows, (..., q)."""
    place = place.clamp(0, len(table) - 1)
    low = place.detach().long().clamp_max(len(table) - 2)
    column = torch.arange(place.shape[-1])
    return torch.lerp(table[low, column], table[low + 1, column], place - low)


def _normalized(log_gain: Array, log_prior: Array) -> Array:
    """Return log densities over the prior's, each row of which has mass one."""
    total = [log_sum_exp(row + log_prior) for row in log_gain]
    return log_gain - np.array(total)[:, None]


def _swept(
    fit: Predictive,
    target: Tensor,
    log_prior: Array,
    grid: Array,
    rng: np.random.Generator,
    *,
    num_burnt: int = 20,
    num_sweeps: int = 80,
    smallest: float = 1e-12,
) -> Array:
    """Return each channel's log marginal over its prior by Gibbs sweeps, (q, grid)."""
    x, mean, cov = target.numpy(), fit.mean.numpy(), fit.cov.numpy()
    log_weight, variances = fit.log_weight.numpy(), np.exp(2 * grid)
    num, residual = len(x), x - mean  # (k, q)
    variance = np.exp(2 * grid[rng.integers(len(grid), size=num)])
    total = np.full((num, len(grid)), -np.inf)
    for sweep in range(num_burnt + num_sweeps):
        noisy = cov + np.diag(variance)
        precision = np.linalg.inv(noisy)
        log_volume = np.linalg.slogdet(noisy)[1]
        for c in rng.permutation(num):
            pulled = np.einsum("kij,kj->ki", precision, residual)
            own = precision[:, c, c]
            off, spread = pulled[:, c] / own, 1 / own
            # Density of all other channels: the whole without this one given them.
            square = (residual * pulled).sum(1) - off**2 * own
            rest = log_weight - 0.5 * (square + log_volume - np.log(spread))
            v = np.maximum(spread - variance[c], smallest)[:, None] + variances
            log_k = rest[:, None] - 0.5 * (off[:, None] ** 2 / v + np.log(v))
            gain = np.logaddexp.reduce(log_k, 0)
            log_p = gain + log_prior
            log_total = log_sum_exp(log_p)
            if sweep >= num_burnt:
                total[c] = np.logaddexp(total[c], gain - log_total)
            p = np.exp(log_p - log_total)
            drawn = variances[rng.choice(len(grid), p=p / p.sum())]
            change = drawn - variance[c]
            grown = 1 + change * own
            column = precision[:, :, c]
            precision = precision - (change / grown)[:, None, None] * (
                column[:, :, None] * column[:, None, :]
            )
            log_volume = log_volume + np.log(grown)
            variance[c] = drawn
    return total - np.log(num_sweeps)


@dataclass(frozen=True)
class Denoised:
    """Denoised outcomes.

    Attributes:
        x: Draws, shape (n, q), in the units of the outcome. Channels that were not
            observed are as the others leave them.
        probability: Probability of misspecification, a channel, shape (q,); NaN where
            it was not observed.
        r_hat: Largest over channels (split, two chains), of x and of the coordinates
            that NUTS runs over; 1 where nothing was observed.
        effective_sample_size: Smallest over the same.
        num_divergences: Divergences of both chains.
    """

    x: Tensor = field(repr=False)
    probability: Tensor
    r_hat: float
    effective_sample_size: float
    num_divergences: int


def denoise(
    x_o: Tensor,
    predictive: Tensor,
    error_model: ErrorModel,
    *,
    seed: int,
    fewest: int = 20,
    smallest: float = 1e-9,
    num_draws: int = 160,
) -> Denoised:
    r"""Return draws of :math:`p(x | x_o) \propto p(x_o | x)\, p(x)`.

    p(x) is a normal mixture fitted to simulations, so that x is what they can give, and
    errors are normal given their deviations :math:`\sigma`. Indicators and x are summed
    out of

    .. math::
        p(\sigma | x_o) \propto L(\sigma) \prod_c p(\sigma_c), \qquad
        L(\sigma) = \sum_k w_k\, N(x_o; \mu_k, \Sigma_k + \mathrm{diag}(\sigma^2)),

    over which NUTS runs, in coordinates in which each channel's posterior is about
    standard normal (:class:`Coordinates`), and x is drawn given each :math:`\sigma`.

    Args:
        x_o: Outcome, shape (q,); NaN where a channel was not observed.
        predictive: Simulations at the executed action, shape (n, q).
        error_model: p(x_o | x) by its deviations.
        seed: Seed of all draws.
        fewest: Number of simulations at least.
        smallest: Share of a channel's size below which its spread is rounding.
        num_draws: Number of draws of each of two chains.

    Raises:
        ValueError: If shapes do not fit, a number is infinite, or a simulation has NaN.
    """
    x_o, predictive = x_o.double(), predictive.double()
    fits = predictive.ndim == 2 and x_o.shape == predictive.shape[1:]
    finite = bool(predictive.isfinite().all()) and not bool(x_o.isinf().any())
    if not (fits and finite) or len(predictive) < fewest:
        raise ValueError(
            f"expected an outcome (q,) and at least {fewest} simulations (n, q) of "
            f"finite numbers; got {tuple(x_o.shape)} and {tuple(predictive.shape)}; "
            "set channels that were not observed to nan in the outcome alone"
        )
    seen = x_o.isfinite()
    center = predictive.mean(0)
    size = torch.maximum(center.abs(), x_o.nan_to_num().abs()) * smallest
    scale = torch.maximum(predictive.std(0), size.clamp_min(1e-300))
    fit = Predictive.fit((predictive - center) / scale, seed)
    target = ((x_o - center) / scale)[seen]
    probability = torch.full_like(x_o, torch.nan)
    r_hat, ess, divergences = 1.0, 2.0 * num_draws, 0
    with (
        forked_generators(seed, "denoise"),
        pyro.validation_enabled(False),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        if not bool(seen.any()):
            x = fit.given(target, torch.zeros(2 * num_draws, 0).double(), seen)
        else:
            own, rng = fit.marginal(seen), np.random.default_rng(seed)
            coordinates = Coordinates(own, target, error_model, rng)
            y, divergences = _nuts(coordinates, torch.full_like(target, 0.7), num_draws)
            x = fit.given(target, coordinates(y).exp(), seen)
            probability[seen] = error_model.misspecified(x[:, seen], target).mean(0)
            chains = torch.cat([x[:, seen], y], 1).reshape(2, num_draws, -1)
            r_hat = float(split_gelman_rubin(chains, chain_dim=0, sample_dim=1).max())
            ess = effective_sample_size(chains, chain_dim=0, sample_dim=1)
            ess = float(ess.min())
    return Denoised(x * scale + center, probability, r_hat, ess, divergences)


def _nuts(
    coordinates: Coordinates,
    start: Tensor,
    num_draws: int,
    *,
    depth: int = 5,
    accepted: float = 0.65,
    num_warmup: int = 40,
) -> tuple[Tensor, int]:
    """Return coordinates (n, q) of two chains, from a start and its mirror image.

    And the number of their divergences.
    """
    draws, divergences = [], 0
    for y in (-start, start):
        # Coordinates are about standard normal: no masses are to be learned.
        kernel = NUTS(
            potential_fn=coordinates.potential,
            step_size=1.0,  # pyright: ignore
            adapt_mass_matrix=False,
            target_accept_prob=accepted,
            max_tree_depth=depth,
        )
        run = MCMC(
            kernel,
            num_draws,
            warmup_steps=num_warmup,
            initial_params={"y": y},
            disable_progbar=True,
        )
        run.run()
        notes: dict[str, Any] = run.diagnostics()
        divergences += sum(len(rows) for rows in notes.get("divergences", {}).values())
        draws.append(run.get_samples()["y"])
    return torch.cat(draws), divergences
