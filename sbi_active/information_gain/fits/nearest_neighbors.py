"""The entropy of outcomes from the distances to their nearest neighbors."""

from __future__ import annotations

import math

import torch
from scipy.spatial import KDTree
from scipy.special import digamma
from torch import Tensor

FLOAT32 = 2.0**-23  # outcomes are float32: no two are closer than their rounding
#: Share of the jackknife's estimate of an outcome's effect on its neighbors. All of it
#: is too much, as distances are not smooth in the outcomes; with .27 the variance of
#: the mean was right for uniform outcomes, one to three dimensions, k = 1 to 10.
SHARED = 0.27


def nearest_neighbor_entropy(x: Tensor, num_neighbors: int) -> Tensor:
    """Return each outcome's contribution to the entropy, (n, d) -> (n,), nats."""
    n, d = x.shape
    center = x.mean(0)
    scale = x.std(0).clamp_min(1e-30)
    z = (x - center) / scale
    covariance = torch.cov(z.T).reshape(d, d) + 1e-12 * torch.eye(d).double()
    factor = torch.linalg.cholesky(covariance)
    z = torch.linalg.solve_triangular(factor, z.T, upper=False).T
    tree = KDTree(z.numpy())
    k = min(num_neighbors + 1, n - 1)
    found, index = tree.query(z.numpy(), k=k + 1)
    floor = FLOAT32 * float((x.abs().amax(0) / scale).max())  # ties
    log_distance = d * torch.from_numpy(found).clamp_min(floor + 1e-300).log()
    log_ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1)
    log_det = factor.diagonal().log().sum() + scale.log().sum()
    constant = float(digamma(n) - digamma(num_neighbors)) + log_ball + log_det
    # a row shortens the distances of those that it is a neighbor of, an error that they
    # share: the balls around them would be larger without it
    larger = (log_distance[:, k] - log_distance[:, num_neighbors])[:, None]
    neighbor = torch.from_numpy(index)[:, 1 : num_neighbors + 1]
    effect = torch.zeros(n, dtype=torch.float64).index_add(
        0, neighbor.flatten(), larger.expand(neighbor.shape).flatten()
    )
    shared = SHARED * (effect - effect.mean())
    return constant + log_distance[:, num_neighbors] - shared
