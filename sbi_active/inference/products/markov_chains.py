"""A belief sampled by Markov chains, sbi's or Pyro's."""

from __future__ import annotations

import torch
from sbi.inference.posteriors import MCMCPosterior
from sbi.inference.potentials.base_potential import BasePotential
from sbi.utils import mcmc_transform
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.products.product import Product

#: sbi's names of its samplers; those that end on "_pymc" need sbi's extra "pymc".
MARKOV_CHAINS = (
    *("slice_np", "slice_np_vectorized", "hmc_pyro", "nuts_pyro"),
    *("slice_pymc", "hmc_pymc", "nuts_pymc"),
)
NUM_WARMUP = 50  # that begin in the posterior already; Pyro's adapt to it meanwhile
NUM_CHAINS = 20  # of a vectorized sampler


class MarkovChainBelief(Belief):
    r"""The product of a learned likelihood over trials, its draws by Markov chains.

    The chains start at draws of the importance sample that normalizes ``log_prob``, so
    that they need not find the posterior, only explore it. Each call of ``sample``
    runs them anew.

    Args:
        product: The same posterior by importance sampling.
        factors: Its learned likelihood.
        method: A name of sbi's, for example "nuts_pyro".
    """

    def __init__(self, product: Belief, factors: Product, method: str) -> None:
        super().__init__(product.prior)
        if method not in MARKOV_CHAINS:
            raise ValueError(
                f"expected a sampler among {', '.join(map(repr, MARKOV_CHAINS))}; got "
                f"{method!r}; choose one of these"
            )
        self.label = f"product over trials, by {method}"
        self._product, self._factors, self._method = product, factors, method
        self.diagnostics = product.diagnostics

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self._product.log_prob(theta)

    def _quick_sample(self, num_samples: int) -> Tensor:
        return self._product._sample(num_samples)

    def _sample(self, num_samples: int) -> Tensor:
        vectorized = self._method == "slice_np_vectorized"
        posterior = MCMCPosterior(
            ProductPotential(self.prior, self._factors),
            proposal=self._product,
            theta_transform=mcmc_transform(self.prior),
            method=self._method,  # pyright: ignore[reportArgumentType]
            warmup_steps=NUM_WARMUP,
            num_chains=min(NUM_CHAINS, num_samples) if vectorized else 1,
            thin=1,
            init_strategy="proposal",
        )
        posterior.set_default_x(torch.zeros(1, 1))  # the trials are in the potential
        return posterior.sample((num_samples,), show_progress_bars=False).detach()


class ProductPotential(BasePotential):
    """Log prior plus the log factors of all trials, as sbi's samplers take it."""

    def __init__(self, prior: Distribution, factors: Product) -> None:
        super().__init__(prior)
        self._factors = factors

    def __call__(self, theta: Tensor, track_gradients: bool = True) -> Tensor:
        """Return the potential, (n, d) -> (n,)."""
        with torch.set_grad_enabled(track_gradients):
            theta = theta.reshape(-1, theta.shape[-1])
            potential = self._factors.log_factors(theta).float()
            potential = potential + self.prior.log_prob(theta)  # pyright: ignore
            region = self._factors.region
            if region is not None:
                z = self._factors.coordinates.to_z(theta.detach())
                outside = ~torch.from_numpy(region.contains(z))
                potential = potential.masked_fill(outside, -torch.inf)
            return potential
