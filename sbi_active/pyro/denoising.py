"""NUTS over the errors of an outcome, and what the simulator would have given."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from sbi_active.pyro.deviations import Coordinates
from sbi_active.pyro.error_models import ErrorModel
from sbi_active.pyro.predictive import Predictive
from sbi_active.seeding import forked_generators

NUM_DRAWS = 160  # of each of two chains


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

    __repr__ = __str__


def denoise(
    x_o: Tensor,
    predictive: Tensor,
    error_model: ErrorModel,
    *,
    seed: int,
    fewest: int = 20,
    smallest: float = 1e-9,
) -> Denoised:
    r"""Return draws of :math:`p(x | x_o) \propto p(x_o | x)\, p(x)`.

    p(x) is a normal mixture fitted to simulations, so that x is what they can give, and
    errors are normal given their deviations :math:`\sigma`. Indicators and x are summed
    out of

    .. math::
        p(\sigma | x_o) \propto L(\sigma) \prod_c p(\sigma_c), \qquad
        L(\sigma) = \sum_k w_k\, N(x_o; \mu_k, \Sigma_k + \mathrm{diag}(\sigma^2)),

    over which NUTS runs, in coordinates in which each channel's posterior is about
    standard normal (``deviations``), and x is drawn given each :math:`\sigma`, exactly.

    Args:
        x_o: Outcome, shape (q,); NaN where a channel was not observed.
        predictive: Simulations at the executed action, shape (n, q).
        error_model: p(x_o | x) by its deviations.
        seed: Seed of all draws.
        fewest: Number of simulations at least.
        smallest: Share of a channel's size below which its spread is rounding.

    Raises:
        ValueError: If shapes do not fit, a number is infinite, or a simulation has NaN.
    """
    x_o, predictive = x_o.double(), predictive.double()
    fits = predictive.ndim == 2 and x_o.shape == predictive.shape[1:]
    if not fits or len(predictive) < fewest:
        raise ValueError(
            f"expected an outcome (q,) and at least {fewest} simulations "
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
    size = torch.maximum(center.abs(), x_o.nan_to_num().abs()) * smallest
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
            own, rng = fit.marginal(seen), np.random.default_rng(seed)
            coordinates = Coordinates(own, target, error_model, rng)
            y, log_sd, divergences = _nuts(own, target, coordinates)
            x = fit.given(target, log_sd.exp(), seen)
            probability[seen] = error_model.misspecified(x[:, seen], target).mean(0)
            r_hat, ess = _figures(torch.cat([x[:, seen], y], 1))
    return Denoised(x * scale + center, probability, r_hat, ess, divergences)


def _nuts(
    fit: Predictive,
    target: Tensor,
    coordinates: Coordinates,
    *,
    depth: int = 5,
    accepted: float = 0.65,
    starts: tuple[float, ...] = (-0.7, 0.7),
    num_warmup: int = 40,
) -> tuple[Tensor, Tensor, int]:
    """Return coordinates and log deviations, both (n, q), and divergences."""

    def potential(sites: dict[str, Tensor]) -> Tensor:
        y = sites["y"]
        log_sd = coordinates(y)
        joint = fit.log_joint(target, log_sd.exp()).logsumexp(-1)
        gain = coordinates.log_gain(log_sd).sum(-1)
        return 0.5 * y.square().sum(-1) - joint + gain

    draws, divergences = [], 0
    for start in starts:
        # Coordinates are about standard normal: no masses are to be learned.
        kernel = NUTS(
            potential_fn=potential,
            step_size=1.0,  # pyright: ignore
            adapt_mass_matrix=False,
            target_accept_prob=accepted,
            max_tree_depth=depth,
        )
        run = MCMC(
            kernel,
            NUM_DRAWS,
            warmup_steps=num_warmup,
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
