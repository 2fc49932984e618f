"""The predictive of simulations as a normal mixture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor

from sbi_active.inference.sampling.mixtures import fitted_normals


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
