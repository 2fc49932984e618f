"""NUTS over what the simulator would have given, had nothing disturbed it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from sbi_active.inference.sampling.population import GaussianMixture
from sbi_active.seeding import forked_generators

NUM_WARMUP, NUM_DRAWS = 100, 150  # of each of two chains
NUM_COMPONENTS = 4  # of the predictive, at most


class ErrorModel(Protocol):
    """A Pyro program of the error of an outcome, in deviations of the predictive."""

    def __call__(self, x: Tensor, x_o: Tensor) -> None:
        """Condition on an outcome."""
        ...

    def misspecified(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return the probability of misspecification a channel, (n, q) -> (n, q)."""
        ...


@dataclass(frozen=True)
class Denoised:
    """Denoised outcomes.

    Attributes:
        x: Draws, shape (n, q), in the units of the outcome.
        probability: Of misspecification, a channel, shape (q,).
        r_hat: Largest over channels (split, two chains).
        effective_sample_size: Smallest over channels.
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

    p(x) is a normal mixture fitted to simulations, so that x is what they can give.
    One chain begins at the outcome and one at a simulation: where they disagree, the
    two ways to see the outcome are far apart and ``r_hat`` says so; the draws are then
    weighted by an exact importance sample over both.

    Args:
        x_o: Outcome, shape (q,).
        predictive: Simulations at the executed action, shape (n, q).
        error_model: p(x_o | x).
        seed: Of everything random.

    Raises:
        ValueError: If shapes do not fit or a number is not finite.
    """
    x_o, predictive = x_o.double(), predictive.double()
    fits = predictive.ndim == 2 and x_o.shape == predictive.shape[1:]
    if not fits or len(predictive) < 20:
        raise ValueError(
            "expected an outcome (q,) and at least 20 simulations (n, q); got "
            f"{tuple(x_o.shape)} and {tuple(predictive.shape)}; pass flat outcomes"
        )
    if not bool(x_o.isfinite().all() and predictive.isfinite().all()):
        raise ValueError(
            "expected finite outcomes; got nan or inf; leave out channels that were "
            "not observed"
        )
    center, scale = predictive.mean(0), predictive.std(0).clamp_min(1e-12)
    own, seen = (predictive - center) / scale, (x_o - center) / scale
    rng = np.random.default_rng(seed)
    fit = GaussianMixture.fit(own.numpy(), NUM_COMPONENTS, rng)
    weight = torch.from_numpy(np.exp(fit.log_weight))
    parts = dist.MultivariateNormal(
        torch.from_numpy(fit.mean), scale_tril=torch.from_numpy(fit.factor)
    )
    prior = dist.MixtureSameFamily(dist.Categorical(weight), parts)

    def program() -> None:
        # A mixture's support has no transform in Pyro: its density enters as a factor.
        base = dist.Normal(torch.zeros_like(seen), 1.0).to_event(1)
        x = pyro.sample("x", base)
        pyro.factor("predictive", prior.log_prob(x) - base.log_prob(x))
        error_model(x, seen)

    with forked_generators(seed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pyro.clear_param_store()
        draws, divergences = [], 0
        for start in (seen, own[int(rng.integers(len(own)))]):
            chain, diverged = _chain(program, start)
            draws.append(chain)
            divergences += diverged
        both = torch.stack(draws)
        figures = _figures(both)
        x = _weighed(both.flatten(0, 1), seen, error_model, prior)
    probability = error_model.misspecified(x, seen).mean(0)
    return Denoised(x * scale + center, probability, *figures, divergences)


def _chain(program: Callable[[], None], start: Tensor) -> tuple[Tensor, int]:
    """Return the draws of a chain, shape (n, q), and its divergences."""
    kernel = NUTS(program, max_tree_depth=5)
    run = MCMC(
        kernel,
        NUM_DRAWS,
        warmup_steps=NUM_WARMUP,
        initial_params={"x": start},
        disable_progbar=True,
    )
    run.run()
    found: dict[str, Any] = run.diagnostics()
    diverged = sum(len(rows) for rows in found.get("divergences", {}).values())
    return run.get_samples()["x"], diverged


def _figures(chains: Tensor) -> tuple[float, float]:
    r_hat = split_gelman_rubin(chains, chain_dim=0, sample_dim=1)
    ess = effective_sample_size(chains, chain_dim=0, sample_dim=1)
    return float(r_hat.max()), float(ess.min())


def _weighed(
    chains: Tensor, seen: Tensor, error_model: ErrorModel, prior: Any
) -> Tensor:
    r"""Return draws of the posterior, from those of chains that may not have mixed.

    A peak at the outcome and the bulk of the predictive are separate modes, between
    which no chain goes. Draws of a kernel mixture around both chains and of the
    predictive are weighted by the program's own density.
    """
    num = 4_000
    local = [(half.mean(0), 1.5 * half.std(0) + 1e-4) for half in chains.chunk(2)]
    kernels = [dist.StudentT(5.0, mean, sd).to_event(1) for mean, sd in local]
    draws = torch.cat(
        [prior.sample((num,)), *(kernel.sample((num,)) for kernel in kernels)]
    )
    densities = [prior.log_prob(draws), *(k.log_prob(draws) for k in kernels)]
    log_q = torch.logsumexp(torch.stack(densities), 0) - np.log(len(densities))

    trace = pyro.poutine.trace(error_model).get_trace(draws, seen)
    trace.compute_log_prob()
    nodes = [n["log_prob"] for n in trace.nodes.values() if "log_prob" in n]
    log_w = sum(nodes) + prior.log_prob(draws) - log_q
    rows = torch.multinomial(log_w.softmax(0), 400, replacement=True)
    return draws[rows]
