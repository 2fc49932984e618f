"""Few directions in place of the many numbers of an outcome, for a network."""

from __future__ import annotations

import torch
from torch import Tensor, nn

BLOCK = 512  # rows in double precision at once, and rows behind principal directions
MOST_FEATURES = 256


class Directions(nn.Module):
    r"""Linear summaries of outcomes: what parameters move, and what moves most.

    Half of the directions at most are the leading right singular vectors of
    :math:`F^\top X`, with X the standardized outcomes and F the parameters, their
    products, and their products with the action; the others are principal directions
    of X beside them.

    Args:
        u: Whitened parameters, shape (n, d).
        x: Outcomes, shape (n, m), all finite.
        action: Actions, shape (n, action_dim).
        num: Number of directions, fewer where rows or numbers are.
    """

    mean: Tensor
    scale: Tensor
    rows: Tensor

    def __init__(self, u: Tensor, x: Tensor, action: Tensor, *, num: int) -> None:
        super().__init__()
        mean, scale = x.mean(0, dtype=torch.float64), x.std(0).double()
        scale = torch.where(scale > 1e-12 * (1 + mean.abs()), scale, 1.0)
        self.register_buffer("mean", mean)
        self.register_buffer("scale", scale)
        features = _features(u, action)
        moved = x.new_zeros(features.shape[1], x.shape[1]).double()
        for row in range(0, len(x), BLOCK):
            part = slice(row, row + BLOCK)
            moved += features[part].T @ self._standardized(x[part])
        rows = torch.linalg.svd(moved, full_matrices=False)[2][: num // 2]
        rest = self._standardized(x[:BLOCK])
        rest = rest - (rest @ rows.T) @ rows
        largest = torch.linalg.svd(rest, full_matrices=False)[2][: num - len(rows)]
        rows = torch.linalg.qr(torch.cat([rows, largest]).T).Q.T
        self.register_buffer("rows", rows.contiguous())

    def forward(self, x: Tensor) -> Tensor:
        """Return summaries, shape (n, k).

        A number that is missing counts as the mean; an outcome without any is NaN.
        """
        parts = [self._summaries(part) for part in x.split(BLOCK)]
        return torch.cat(parts)

    def _summaries(self, x: Tensor) -> Tensor:
        seen = x.isfinite()
        known = torch.where(seen, self._standardized(x), 0.0) @ self.rows.T
        return torch.where(seen.any(1, keepdim=True), known, torch.nan)

    def _standardized(self, x: Tensor) -> Tensor:
        return (x.double() - self.mean) / self.scale


def _features(u: Tensor, action: Tensor) -> Tensor:
    """Return standardized products of parameters and actions, shape (n, f)."""
    a = (action.double() - action.mean(0)) / action.std(0).clamp_min(1e-30)
    i, j = torch.triu_indices(u.shape[1], u.shape[1])
    parts = [u, *(u * a[:, [k]] for k in range(a.shape[1]))]
    parts += [u * a[:, [k]].square() for k in range(a.shape[1])]
    features = torch.cat([*parts, u[:, i] * u[:, j]], 1)[:, :MOST_FEATURES]
    features = features - features.mean(0)
    return features / features.std(0).clamp_min(1e-30)
