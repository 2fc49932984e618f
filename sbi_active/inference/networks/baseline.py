"""A Gaussian posterior by regression of the outcome, the frame a network works in."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from sbi_active.inference.networks.response import Response, held_out


class Frames(NamedTuple):
    r"""Affine coordinates of each row, :math:`v = U (u - m)`.

    Attributes:
        mean: m, shape (n, J, d).
        factor: U, upper triangular, shape (n, J, d, d).
        misfit: Half the squared residual and prior distance at m, shape (n, J).
    """

    mean: Tensor
    factor: Tensor
    misfit: Tensor

    @staticmethod
    def trivial(rows: Tensor, dim: int) -> Frames:
        """Return a frame of each row (n, ...) that changes nothing."""
        n, eye = len(rows), torch.eye(dim, dtype=rows.dtype, device=rows.device)
        zero, nothing = rows.new_zeros(n, 1, dim), rows.new_zeros(n, 1)
        return Frames(zero, eye.expand(n, 1, dim, dim), nothing)

    def with_global(self) -> Frames:
        """Return these and, last, the trivial one."""
        last = Frames.trivial(self.mean, self.mean.shape[-1])
        return Frames(*(torch.cat(pair, 1) for pair in zip(self, last, strict=True)))

    @property
    def log_det(self) -> Tensor:
        r""":math:`\log |\mathrm d v / \mathrm d u|`, shape (n, J)."""
        return self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


class Baseline(Response):
    r"""Gaussian posterior of whitened parameters u, exact where x is linear in u.

    The regression f of the outcome, with noise of covariance S, is inverted by Bayes'
    rule for :math:`u \sim \mathcal N(0, I)`:

    .. math::
        m &= \arg\min_u \tfrac12 |u|^2 + \tfrac12 |x - f(\xi, u)|^2_{S^{-1}}, \qquad
        U^\top U = I + J^\top S^{-1} J, \quad J = \partial_u f(\xi, m).

    "linear" has :math:`\psi = (1, u)`: one Gauss-Newton step is exact. "curved" takes
    damped steps from two starts, the better of the training parameters and the one that
    the first solution explains worst, so that a second mode has a frame of its own.
    Last, :math:`v = U (u - m)` is standardized given the action, which absorbs misfit.

    Args:
        u: Whitened parameters, shape (n, d).
        y: Finite outcomes, of scale one over all actions, shape (n, m).
        action: Actions, shape (n, action_dim).
        kind: Whether f is linear in u.
        num_centers: Number of training parameters among which a row finds its starts.
        num_scaled: Number of rows of a curved baseline that standardize v.
    """

    def __init__(
        self,
        u: Tensor,
        y: Tensor,
        action: Tensor,
        *,
        kind: Literal["linear", "curved"],
        num_centers: int = 32,
        num_scaled: int = 1_500,
    ) -> None:
        super().__init__(u, y, action, kind=kind)
        test = held_out(len(u))
        self.centers = nn.Buffer(u[~test][:num_centers].clone())

        self.residual_scaling: Response | None = None
        some = slice(num_scaled if kind == "curved" else None)
        frames = self(y[some], action[some])
        v = nearest(local(u[some], frames), frames)
        self.residual_scaling = Response.marginal(v, action[some])

    def forward(self, y: Tensor, action: Tensor, *, block: int = 4_096) -> Frames:
        """Return the frames of outcomes (n, m) and actions (n, action_dim)."""
        blocks = zip(y.split(block), action.split(block), strict=True)
        parts = zip(*(self._frames(*block) for block in blocks), strict=True)
        return Frames(*(torch.cat(part) for part in parts))

    def _frames(self, y: Tensor, action: Tensor) -> Frames:
        # From here on outcomes are in units of their noise, which is N(0, I).
        whitener, beta = self.weights(action)
        y = (whitener @ y[..., None])[..., 0]
        beta = beta @ whitener.mT
        if self.kind == "linear":
            start = torch.zeros_like(self.centers[:1]).expand(len(y), 1, -1)
            misfit, gradient, root = self._expand(start, y, beta)
            mean = start - torch.linalg.solve(root.mT @ root, gradient)
            # No clamp to the rows' range here: the linear f holds everywhere.
            misfit = misfit + 0.5 * (gradient * (mean - start)).sum(-1)
        else:
            mean, misfit, root = self._minimize(y, beta)
        factor = upper_factor(root)
        if self.residual_scaling is not None:
            location, scale = self.residual_scaling.location_and_scale(action)
            location = location[:, None, :, None]
            step = torch.linalg.solve_triangular(factor, location, upper=True)
            mean, factor = mean + step[..., 0], factor / scale[:, None, :, None]
        return Frames(mean, factor, misfit)

    def _minimize(self, y: Tensor, beta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return solution, misfit and root of the precision of two starts a row."""
        residual = y[:, None] - self.parameter_basis(self.centers) @ beta
        misfit = 0.5 * (residual.square().sum(-1) + self.centers.square().sum(-1))
        first = self._descend(self.centers[misfit.argmin(1)][:, None], y, beta)
        # Distances of the centers to the quadratic around the first solution.
        step = self.centers - first[0]
        quadratic = (step @ first[2][:, 0].mT).square().sum(-1) * 0.5 + first[1]
        second = (misfit.log() - quadratic.clamp_min(1e-12).log()).argmin(1)
        second = self._descend(self.centers[second][:, None], y, beta)
        mean, misfit, root = map(
            partial(torch.cat, dim=1), zip(first, second, strict=True)
        )
        return mean, misfit, root

    def _descend(
        self,
        u: Tensor,
        y: Tensor,
        beta: Tensor,
        *,
        num_steps: int = 7,
        initial: float = 1e-2,
        at_rest: float = 1e-3,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Take damped Gauss-Newton steps, each accepted where it improves.

        Damping falls or rises by ten; rows end once a step gains less than ``at_rest``.
        """
        low = self.parameter_basis.center - self.parameter_basis.half_width
        high = self.parameter_basis.center + self.parameter_basis.half_width
        damping = torch.full_like(u[..., :1], initial)
        state = (u, *self._expand(u, y, beta))
        rows = torch.arange(len(u), device=u.device)  # not yet at rest
        for _ in range(num_steps):
            u, misfit, gradient, root = own = [each[rows] for each in state]
            diagonal = root.square().sum(-2)
            damped = root.mT @ root + torch.diag_embed(damping * diagonal)
            proposed = u - torch.linalg.solve(damped, gradient)
            proposed = torch.minimum(torch.maximum(proposed, low), high)
            new = (proposed, *self._expand(proposed, y[rows], beta[rows]))
            better = new[1] < misfit
            for k, (a, b) in enumerate(zip(own, new, strict=True)):
                is_new = better.reshape(*better.shape, *[1] * (a.ndim - 2))
                state[k][rows] = torch.where(is_new, b, a)
            restless = ~(better & (misfit - new[1] < at_rest)).all(1)
            damping = torch.where(better[..., None], 0.1 * damping, 10.0 * damping)
            rows, damping = rows[restless], damping[restless]
        return state[0], state[1], state[3]

    def _expand(
        self, u: Tensor, y: Tensor, beta: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return misfit (n, J), its gradient (n, J, d) and a root of its Hessian.

        The root is (I, J) stacked, of Gauss and Newton's Hessian, (n, J, d + m, d).
        """
        psi, slope = self.parameter_basis.with_jacobian(u)
        residual = y[:, None] - psi @ beta
        jacobian = beta[:, None].mT @ slope  # (n, J, m, d)
        misfit = 0.5 * (residual.square().sum(-1) + u.square().sum(-1))
        gradient = u - (residual[..., None, :] @ jacobian)[..., 0, :]
        eye = torch.eye(u.shape[-1], dtype=u.dtype, device=u.device)
        eye = eye.expand(*u.shape, -1)
        return misfit, gradient, torch.cat([eye, jacobian], -2)


def upper_factor(root: Tensor) -> Tensor:
    """Return U of a positive diagonal, with U^T U = A^T A for A (..., n, d).

    A product A^T A would lose the identity in A where noise is nearly nothing.
    """
    upper = torch.linalg.qr(root, mode="r").R
    return (
        upper * torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)[..., None]
    )


def local(u: Tensor, frames: Frames) -> Tensor:
    """Return v in every frame, (..., n, d) -> (..., n, J, d)."""
    step = u[..., None, :] - frames.mean
    return (frames.factor * step[..., None, :]).sum(-1)


def nearest(v: Tensor, frames: Frames) -> Tensor:
    """Return v in the frame of highest density, (n, J, d) -> (n, d)."""
    log_density = frames.log_det - 0.5 * v.square().sum(-1)
    return v[torch.arange(len(v)), log_density.argmax(1)]
