r"""Posteriors over the parameters of a noise model.

All have the same form: cells of the one shared parameter (a correlation time, degrees
of freedom), and given the cell, independent standard deviations of the channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from scipy.special import chdtri
from torch import Tensor
from torch.distributions import Distribution


@dataclass(frozen=True)
class InverseChiSquare:
    r"""Scaled inverse chi-square variances, :math:`\nu s^2 / \sigma^2 \sim \chi^2_\nu`.

    Args:
        freedom: :math:`\nu`, shape (channels,).
        variance: :math:`s^2`, shape (cells, channels).

    References:
        Gelman et al., Bayesian Data Analysis, 3rd edition, section 3.2.
    """

    freedom: Tensor
    variance: Tensor

    @property
    def num_channels(self) -> int:
        """Number of standard deviations."""
        return len(self.freedom)

    def quantile(self, cell: Tensor, uniform: Tensor) -> Tensor:
        """Return sd at cells (n,) and levels (n, channels)."""
        chi_square = chdtri(self.freedom.numpy(), uniform.numpy())
        return (
            self.freedom * self.variance[cell] / torch.from_numpy(chi_square)
        ).sqrt()

    def log_evidence(self, square: Tensor, count: Tensor, cell: int) -> Tensor:
        r"""Return the log density of Gaussian numbers with their size integrated out.

        .. math::
            \int \prod_{j=1}^{m} N(e_j; 0, \sigma^2) \, p(\sigma) \, d\sigma =
            \frac{\Gamma(\frac{\nu + m}{2})}{\Gamma(\frac{\nu}{2})
            (\pi \nu s^2)^{m / 2}}
            \left( 1 + \frac{\sum_j e_j^2}{\nu s^2} \right)^{-\frac{\nu + m}{2}}

        Args:
            square: Sum of squares, shape (n, channels).
            count: Number m of the squares, shape (n, channels).
            cell: Cell of the shared parameter.

        Returns:
            Shape (n, channels), nats.
        """
        freedom = self.freedom.to(square)
        total = freedom * self.variance[cell].to(square)
        return (
            torch.lgamma(0.5 * (freedom + count))
            - torch.lgamma(0.5 * freedom)
            - 0.5 * count * torch.log(math.pi * total)
            - 0.5 * (freedom + count) * torch.log1p(square / total)
        )


@dataclass(frozen=True)
class Cells:
    r"""A density on a positive number, constant in its logarithm within each cell.

    Args:
        edges: Edges of the cells, increasing, shape (..., cells + 1).
        log_weight: Log probability of the cells, shape (..., cells).
    """

    edges: Tensor
    log_weight: Tensor

    @property
    def nodes(self) -> Tensor:
        """Geometric middle of the cells, shape (..., cells)."""
        return (self.edges[..., 1:] * self.edges[..., :-1]).sqrt()

    def quantile(self, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cell and the value at levels of the leading shape."""
        edges, log_weight = (
            part.expand(*uniform.shape, -1).contiguous()
            for part in (self.edges, self.log_weight)
        )
        mass = log_weight.exp()
        above = mass.cumsum(-1)
        above = above / above[..., -1:]
        last = mass.shape[-1] - 1
        level = uniform[..., None].contiguous()
        cell = torch.searchsorted(above, level).clamp_max(last)
        top, share = above.gather(-1, cell), mass.gather(-1, cell)
        within = 1 - ((top - level) / share).clamp(0, 1)
        low, high = edges.gather(-1, cell), edges.gather(-1, cell + 1)
        return cell[..., 0], (low * (high / low) ** within)[..., 0]


@dataclass(frozen=True)
class SdGrid:
    """Standard deviations on a grid.

    Args:
        edges: Edges of the cells of sd, shape (channels, s + 1).
        log_weight: Log probability of the cells, shape (cells, channels, s).
    """

    edges: Tensor
    log_weight: Tensor

    @property
    def num_channels(self) -> int:
        """Number of standard deviations."""
        return len(self.edges)

    @property
    def nodes(self) -> Tensor:
        """Geometric middle of the cells, shape (channels, s)."""
        return Cells(self.edges, self.log_weight).nodes

    def quantile(self, cell: Tensor, uniform: Tensor) -> Tensor:
        """Return sd at cells (n,) and levels (n, channels)."""
        return Cells(self.edges, self.log_weight[cell]).quantile(uniform)[1]

    def log_evidence(self, square: Tensor, count: Tensor, cell: int) -> Tensor:
        r"""Return the log density of Gaussian numbers with their size summed out.

        .. math::
            \sum_k P(\sigma_k) \prod_{j=1}^{m} N(e_j; 0, \sigma_k^2)

        Arguments are those of :meth:`.InverseChiSquare.log_evidence`.
        """
        nodes, weight = self.nodes.to(square), self.log_weight[cell].to(square)
        density = -0.5 * square[..., None] / nodes**2 - count[..., None] * nodes.log()
        return (density + weight).logsumexp(-1) - 0.5 * count * math.log(2 * math.pi)


class NoisePosterior(Distribution):
    r"""Posterior of standard deviations and at most one shared parameter.

    .. math::
        p(\sigma_1, \ldots, \sigma_c, \psi | D) =
        p(\psi | D) \prod_i p(\sigma_i | \psi, D)

    Args:
        sd: Standard deviations given the cell of the shared parameter.
        shared: Cells and weights (shape (cells,)) of the shared parameter :math:`\psi`;
            None if there is none.
    """

    arg_constraints: dict[str, Any] = {}  # pyright: ignore

    def __init__(
        self, sd: InverseChiSquare | SdGrid, *, shared: Cells | None = None
    ) -> None:
        self.sd, self.shared = sd, shared
        num = sd.num_channels + (shared is not None)
        super().__init__(torch.Size(), torch.Size([num]), validate_args=False)

    @property
    def cells(self) -> list[tuple[float, float]]:
        """Middle and log weight of each cell of the shared parameter; one without."""
        if self.shared is None:
            return [(math.nan, 0.0)]
        own = self.shared.nodes.tolist(), self.shared.log_weight.tolist()
        return [*zip(*own, strict=True)]

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:  # pyright: ignore
        """Return draws from torch's global generator, shape (*sample_shape, p)."""
        shape = (*sample_shape, *self.event_shape)
        uniform = torch.rand(shape, dtype=torch.float64).reshape(-1, shape[-1])
        return self.quantile(uniform).reshape(shape)

    def quantile(self, uniform: Tensor) -> Tensor:
        """Return the draws that belong to uniform numbers, (n, p) -> (n, p)."""
        c = self.sd.num_channels
        # torch.rand may give 0, where a standard deviation would be 0
        uniform = uniform.clamp(1e-16, 1 - 1e-16)
        cell = torch.zeros(len(uniform), dtype=torch.long)
        if self.shared is None:
            return self.sd.quantile(cell, uniform)
        cell, value = self.shared.quantile(uniform[:, c])
        sd = self.sd.quantile(cell, uniform[:, :c])
        return torch.cat([sd, value[:, None]], 1)
