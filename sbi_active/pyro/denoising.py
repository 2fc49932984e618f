r"""An error model of an outcome, and what the simulator would have given.

All numbers are in deviations of the predictive, channel by channel. Every error is
normal given its own deviation :math:`\sigma_c`, of which a channel that is right has a
small one. Gibbs sweeps draw the deviations from

.. math::
    p(\sigma_c | \sigma_{-c}, x_o) \propto p(\sigma_c) \sum_k
        w_k(\sigma_{-c})\, N(x_{o,c};\, m_{kc},\, v_{kc} + \sigma_c^2)

on a grid, in which x, a normal mixture, its components and whether a channel is right
are summed out; x is drawn given the deviations.

References:
    Ward, Cannon, Beaumont, Fasiolo & Schmon, "Robust neural posterior estimation and
    statistical model criticism", NeurIPS 2022.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyro.distributions as dist
import torch
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from sbi_active.inference.sampling.mixtures import fitted_normals
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import forked_generators


@dataclass(frozen=True)
class SpikeAndSlab:
    r"""Each channel is right, or off by anything.

    .. math::
        x_o - x \sim (1 - \rho)\, N(0, s^2) + \rho\, t_3(0, S^2)

    Attributes:
        probability: Probability of misspecification of a channel, :math:`\rho`.
        spike: s; small beside the noise, which the predictive has already.
        slab: S.
    """

    probability: float = 0.1
    spike: float = 0.005
    slab: float = 10.0

    def misspecified(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return probabilities given denoised outcomes (n, q), shape (n, q)."""
        right = dist.Normal(x, self.spike).log_prob(x_o) + np.log(1 - self.probability)
        wrong = dist.StudentT(3.0, x, self.slab).log_prob(x_o)
        return torch.sigmoid(wrong + np.log(self.probability) - right)

    def log_deviation(self, log_sd: Tensor, *, rounded: float = 0.1) -> Tensor:
        """Return the log density of the log deviation of a channel's error, (n,).

        That of the spike is rounded; that of the slab is log(S) + log(v) / 2, v inverse
        gamma.
        """
        right = dist.Normal(float(np.log(self.spike)), rounded).log_prob(log_sd)
        v = torch.exp(2 * (log_sd - float(np.log(self.slab))))
        wrong = dist.InverseGamma(1.5, 1.5).log_prob(v) + v.log() + np.log(2.0)
        return torch.logaddexp(
            right + np.log(1 - self.probability), wrong + np.log(self.probability)
        )


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


def swept(
    fit: Predictive,
    target: Tensor,
    error_model: SpikeAndSlab,
    rng: np.random.Generator,
    num_draws: int,
    *,
    num_burnt: int = 20,
    lowest: float = 1e-4,
    num_grid: int = 1_000,
    smallest: float = 1e-12,
) -> Tensor:
    """Return draws of the channels' deviations by Gibbs sweeps, (num_draws, q).

    Args:
        fit: Predictive of the channels that were seen.
        target: Outcome of these channels, shape (q,).
        error_model: Error model of the deviations.
        rng: Source of the draws.
        num_draws: Number of sweeps that are kept.
        num_burnt: Number of sweeps before.
        lowest: Smallest deviation of the grid.
        num_grid: Number of deviations of the grid, which are 1.5 % apart.
        smallest: Variance of a channel given the others at least.
    """
    highest = np.log(10 * float(target.abs().max()) + 100)
    grid = np.linspace(np.log(lowest), highest, num_grid)
    log_prior = error_model.log_deviation(torch.from_numpy(grid)).numpy()
    mean, cov = fit.mean.numpy(), fit.cov.numpy()
    log_weight, variances = fit.log_weight.numpy(), np.exp(2 * grid)
    num, residual = len(target), target.numpy() - mean  # (k, q)
    variance = variances[rng.integers(num_grid, size=num)]
    kept = []
    for _ in range(num_burnt + num_draws):
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
            log_p = np.logaddexp.reduce(log_k, 0) + log_prior
            p = np.exp(log_p - log_sum_exp(log_p))
            drawn = variances[rng.choice(num_grid, p=p / p.sum())]
            change = drawn - variance[c]
            grown = 1 + change * own
            column = precision[:, :, c]
            precision = precision - (change / grown)[:, None, None] * (
                column[:, :, None] * column[:, None, :]
            )
            log_volume = log_volume + np.log(grown)
            variance[c] = drawn
        kept.append(np.sqrt(variance))
    return torch.from_numpy(np.stack(kept[num_burnt:]))


@dataclass(frozen=True)
class Denoised:
    """Denoised outcomes.

    Attributes:
        x: Draws, shape (n, q), in the units of the outcome. Channels that were not
            observed are as the others leave them.
        probability: Probability of misspecification, a channel, shape (q,); NaN where
            it was not observed.
        r_hat: Largest over channels (split, two chains), of x and of the logarithms of
            their deviations; 1 where nothing was observed.
        effective_sample_size: Smallest over the same.
    """

    x: Tensor = field(repr=False)
    probability: Tensor
    r_hat: float
    effective_sample_size: float


def denoise(
    x_o: Tensor,
    predictive: Tensor,
    error_model: SpikeAndSlab,
    *,
    seed: int,
    fewest: int = 20,
    smallest: float = 1e-9,
    num_draws: int = 160,
) -> Denoised:
    r"""Return draws of :math:`p(x | x_o) \propto p(x_o | x)\, p(x)`.

    p(x) is a normal mixture fitted to simulations, so that x is what they can give;
    deviations are drawn by :func:`swept`, in two chains.

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
    r_hat, ess = 1.0, 2.0 * num_draws
    own, rng = fit.marginal(seen), np.random.default_rng(seed)
    sd = torch.zeros(2 * num_draws, 0).double()
    with forked_generators(seed, "denoise"):
        if bool(seen.any()):
            given = own, target, error_model, rng, num_draws
            sd = torch.cat([swept(*given), swept(*given)])
        x = fit.given(target, sd, seen)
    if bool(seen.any()):
        probability[seen] = error_model.misspecified(x[:, seen], target).mean(0)
        chains = torch.cat([x[:, seen], sd.log()], 1).reshape(2, num_draws, -1)
        r_hat = float(split_gelman_rubin(chains, chain_dim=0, sample_dim=1).max())
        ess = effective_sample_size(chains, chain_dim=0, sample_dim=1).min()
    return Denoised(x * scale + center, probability, r_hat, float(ess))
