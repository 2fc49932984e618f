"""NUTS over the errors of an outcome, and what the simulator would have given."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from sbi_active.inference.sampling.population import GaussianMixture
from sbi_active.pyro.error_models import ErrorModel
from sbi_active.seeding import forked_generators

NUM_WARMUP, NUM_DRAWS = 40, 160  # of each of two chains
MAX_TREE_DEPTH = 5
ACCEPTED = 0.65  # share of moves that steps are adapted to: the density is smooth
STARTS = (-0.7, 0.7)  # of the coordinates; they are standard normal, channels alone
NUM_COMPONENTS = 4  # of the predictive, at most
LEAST_SIMULATIONS = 20
SMALLEST = 1e-9  # of a channel's size: a spread below is rounding
LOWEST, NUM_GRID = 1e-4, 1_000  # of deviations: the least, and how many
REACH, NUM_KNOTS = 6.0, 1_201  # of the coordinates
TEMPERED = 0.3  # power of what a channel says alone; others may say the contrary


@dataclass(frozen=True)
class Denoised:
    """Denoised outcomes.

    Attributes:
        x: Draws, shape (n, q), in the units of the outcome. Channels that were not
            observed are as the others leave them.
        probability: Of misspecification, a channel, shape (q,); NaN where it was not
            observed.
        r_hat: Largest over channels (split, two chains), of x and of the coordinates
            that NUTS runs over; 1 where nothing was observed.
        effective_sample_size: Smallest over the same.
        num_divergences: Of both chains.
    """

    x: Tensor
    probability: Tensor
    r_hat: float
    effective_sample_size: float
    num_divergences: int

    def __str__(self) -> str:
        shares = ", ".join(f"{p:.2f}" for p in self.probability.tolist())
        return (
            f"probability of misspecification a channel: {shares}\n"
            f"NUTS: r_hat {self.r_hat:.3f}, {self.effective_sample_size:.0f} effective "
            f"draws, {self.num_divergences} divergences"
        )


def denoise(
    x_o: Tensor, predictive: Tensor, error_model: ErrorModel, *, seed: int
) -> Denoised:
    r"""Return draws of :math:`p(x | x_o) \propto p(x_o | x)\, p(x)`.

    p(x) is a normal mixture fitted to simulations, so that x is what they can give, and
    errors are normal given their deviations :math:`\sigma`. Indicators and x are summed
    out of

    .. math::
        p(\sigma | x_o) \propto L(\sigma) \prod_c p(\sigma_c), \qquad
        L(\sigma) = \sum_k w_k\, N(x_o; \mu_k, \Sigma_k + \mathrm{diag}(\sigma^2)),

    over which NUTS runs, and x is drawn given each :math:`\sigma`, exactly. A channel
    may be right or wrong, two peaks of :math:`\log \sigma_c` between which no chain
    goes. Its coordinate is therefore :math:`y_c = \Phi^{-1}(F_c(\sigma_c))`, with
    :math:`F_c \propto p(\sigma_c) L_c^{.3}` the tempered posterior of a channel that
    were alone, on a grid: in it both peaks are one normal, and what is left for NUTS,
    :math:`N(y; 0, 1)\, L / \prod_c L_c^{.3}`, has one peak.

    Args:
        x_o: Outcome, shape (q,); NaN where a channel was not observed.
        predictive: Simulations at the executed action, shape (n, q).
        error_model: p(x_o | x) by its deviations.
        seed: Of everything random.

    Raises:
        ValueError: If shapes do not fit, a number is infinite, or a simulation has NaN.
    """
    x_o, predictive = x_o.double(), predictive.double()
    fits = predictive.ndim == 2 and x_o.shape == predictive.shape[1:]
    if not fits or len(predictive) < LEAST_SIMULATIONS:
        raise ValueError(
            f"expected an outcome (q,) and at least {LEAST_SIMULATIONS} simulations "
            f"(n, q); got {tuple(x_o.shape)} and {tuple(predictive.shape)}; pass flat "
            "outcomes"
        )
    if bool(x_o.isinf().any()) or not bool(predictive.isfinite().all()):
        raise ValueError(
            "expected finite numbers; got inf, or nan in a simulation; set channels "
            "that were not observed to nan in the outcome alone"
        )
    seen = x_o.isfinite()
    center = predictive.mean(0)
    size = torch.maximum(center.abs(), x_o.nan_to_num().abs()) * SMALLEST
    scale = torch.maximum(predictive.std(0), size.clamp_min(1e-300))
    fit = Predictive.fit((predictive - center) / scale, seed)
    target = ((x_o - center) / scale)[seen]
    probability = torch.full_like(x_o, torch.nan)
    r_hat, ess, divergences = 1.0, 2.0 * NUM_DRAWS, 0
    with (
        forked_generators(seed, "denoise"),
        pyro.validation_enabled(False),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        if not bool(seen.any()):
            x = fit.given(target, torch.zeros(2 * NUM_DRAWS, 0).double(), seen)
        else:
            y, log_sd, divergences = _nuts(fit.marginal(seen), target, error_model)
            x = fit.given(target, log_sd.exp(), seen)
            probability[seen] = error_model.misspecified(x[:, seen], target).mean(0)
            r_hat, ess = _figures(torch.cat([x[:, seen], y], 1))
    return Denoised(x * scale + center, probability, r_hat, ess, divergences)


@dataclass(frozen=True)
class Predictive:
    """A normal mixture.

    Attributes:
        log_weight: Shape (k,).
        mean: Shape (k, q).
        cov: Shape (k, q, q).
    """

    log_weight: Tensor
    mean: Tensor
    cov: Tensor

    @staticmethod
    def fit(x: Tensor, seed: int) -> Predictive:
        """Return a fit to rows (n, q)."""
        rng = np.random.default_rng(seed)
        found = GaussianMixture.fit(x.numpy(), NUM_COMPONENTS, rng)
        factor = torch.from_numpy(found.factor)
        mean, log_weight = map(torch.from_numpy, (found.mean, found.log_weight))
        return Predictive(log_weight, mean, factor @ factor.mT)

    def marginal(self, seen: Tensor) -> Predictive:
        """Return that of some channels, a boolean of shape (q,)."""
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
    """Log deviations as functions of standard normal coordinates.

    Args:
        fit: Of the channels that were seen.
        target: Their outcome, shape (q,).
        error_model: Of the deviations.
    """

    def __init__(
        self, fit: Predictive, target: Tensor, error_model: ErrorModel
    ) -> None:
        highest = 10 * float(target.abs().max()) + 100
        ends = float(np.log(LOWEST)), float(np.log(highest))
        grid = torch.linspace(*ends, NUM_GRID, dtype=target.dtype)
        log_alone = fit.log_alone(target, grid.exp()[:, None].expand(-1, len(target)))
        log_p = error_model.log_deviation(grid)[:, None] + TEMPERED * log_alone
        p = (log_p - log_p.amax(0)).exp()
        p = torch.cat([torch.zeros_like(p[:1]), 0.5 * (p[1:] + p[:-1])])
        cdf = (p.cumsum(0) / p.sum(0)).T.numpy()
        y = torch.linspace(-REACH, REACH, NUM_KNOTS, dtype=target.dtype)
        levels = dist.Normal(0.0, 1.0).cdf(y).numpy()
        # Where nothing is likely the distribution is flat, and has no inverse.
        rising = np.arange(NUM_GRID) * 1e-15
        self._knots = torch.from_numpy(
            np.stack([np.interp(levels, row + rising, grid.numpy()) for row in cdf], 1)
        )

    def __call__(self, y: Tensor) -> Tensor:
        """Return log deviations, (..., q) to (..., q)."""
        place = (y + REACH) * ((NUM_KNOTS - 1) / (2 * REACH))
        place = place.clamp(0, NUM_KNOTS - 1)
        low = place.detach().long().clamp_max(NUM_KNOTS - 2)
        column = torch.arange(y.shape[-1])
        ends = self._knots[low, column], self._knots[low + 1, column]
        return torch.lerp(*ends, place - low)


def _nuts(
    fit: Predictive, target: Tensor, error_model: ErrorModel
) -> tuple[Tensor, Tensor, int]:
    """Return coordinates and log deviations, both (n, q), and divergences."""
    coordinates = Coordinates(fit, target, error_model)

    def potential(sites: dict[str, Tensor]) -> Tensor:
        y = sites["y"]
        sd = coordinates(y).exp()
        joint = fit.log_joint(target, sd).logsumexp(-1)
        alone = fit.log_alone(target, sd).sum(-1)
        return 0.5 * y.square().sum(-1) - joint + TEMPERED * alone

    draws, divergences = [], 0
    for start in STARTS:
        # Coordinates are about standard normal: no masses are to be learned.
        kernel = NUTS(
            potential_fn=potential,
            step_size=1.0,  # pyright: ignore
            adapt_mass_matrix=False,
            target_accept_prob=ACCEPTED,
            max_tree_depth=MAX_TREE_DEPTH,
        )
        run = MCMC(
            kernel,
            NUM_DRAWS,
            warmup_steps=NUM_WARMUP,
            initial_params={"y": torch.full_like(target, start)},
            disable_progbar=True,
        )
        run.run()
        notes: dict[str, Any] = run.diagnostics()
        divergences += sum(len(rows) for rows in notes.get("divergences", {}).values())
        draws.append(run.get_samples()["y"])
    y = torch.cat(draws)
    return y, coordinates(y), divergences


def _figures(draws: Tensor) -> tuple[float, float]:
    """Return the largest r_hat and the smallest effective number of draws."""
    chains = draws.reshape(2, -1, draws.shape[-1])
    r_hat = split_gelman_rubin(chains, chain_dim=0, sample_dim=1)
    ess = effective_sample_size(chains, chain_dim=0, sample_dim=1)
    return float(r_hat.max()), float(ess.min())
