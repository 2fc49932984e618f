"""A Gaussian posterior by regression of the outcome, the frame a network works in."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from sbi_active.inference.scaling import (
    ActionScaling,
    Polynomials,
    best_prefix,
    exponents_of,
    fit_location_and_scale,
    held_out,
)

__all__ = ["Baseline", "Frames"]

BLOCK = 4_096  # rows held in memory at once
MAX_FEATURES = 260  # of (action, parameters)
MAX_ACTION_DEGREE = 14
MAX_DEGREE = 9  # of the parameters
MAX_NOISE_DEGREE = 8
JOINT_COST = 1.5  # degrees that a product of two parameters counts more
NUM_CENTERS = 32
NUM_STEPS = 7
INITIAL_DAMPING = 1e-2
AT_REST = 1e-3  # nat
NUM_SCALING_ROWS = 1_500


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

    @property
    def log_det(self) -> Tensor:
        r""":math:`\log |\mathrm d v / \mathrm d u|`, shape (n, J)."""
        return self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


class Baseline(nn.Module):
    r"""Gaussian posterior of whitened parameters u, exact where x is linear in u.

    The outcome is regressed on polynomials of action and parameters, with a covariance
    that depends on the action, and the regression is inverted by Bayes' rule:

    .. math::
        x &= f(\xi, u) + e, \qquad f = \sum_{kj} \beta_{kj}\, \phi_k(\xi)\, \psi_j(u),
        \quad e \sim \mathcal N(0, S(\xi)), \quad u \sim \mathcal N(0, I), \\
        m &= \arg\min_u \tfrac12 |u|^2 + \tfrac12 |x - f(\xi, u)|^2_{S^{-1}}, \qquad
        U^\top U = I + J^\top S^{-1} J, \quad J = \partial_u f(\xi, m).

    "linear" has :math:`\psi = (1, u)`: one Gauss-Newton step is exact. "curved" takes
    damped steps from two starts, the better of the training parameters and the one that
    the first solution explains worst, so that a second mode has a frame of its own.
    Last, :math:`v = U (u - m)` is standardized given the action, which absorbs misfit.

    Args:
        u: Whitened parameters, shape (n, d).
        y: Finite outcomes, of scale one over all actions, shape (n, m).
        action: Shape (n, action_dim).
        kind: Whether f is linear in u.
    """

    beta: Tensor
    gamma: Tensor
    whitener: Tensor
    log_low: Tensor
    log_high: Tensor
    centers: Tensor

    def __init__(
        self,
        u: Tensor,
        y: Tensor,
        action: Tensor,
        *,
        kind: Literal["linear", "curved"],
        log_scale: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.kind = kind
        test = held_out(len(u))
        num_train, dim = int((~test).sum()), u.shape[1]
        most = min(MAX_FEATURES, num_train // 8)
        exponents, sizes = exponents_of(
            action, max_degree=MAX_ACTION_DEGREE, max_terms=max(1, most // (1 + dim))
        )
        degree = MAX_DEGREE if kind == "curved" else 1
        # A degree more than there is data for costs nothing: terms are cut off below.
        inner, _ = exponents_of(u, max_degree=degree, max_terms=max(1 + dim, most))
        self.action_basis = Polynomials(action, exponents)
        self.parameter_basis = Polynomials(u, inner)
        phi, psi = self.action_basis(action), self.parameter_basis(u)
        degrees = min(len(sizes), MAX_NOISE_DEGREE + 1)
        noise = phi[:, : sizes[degrees - 1]]

        k, j, prefixes = _joint_terms(exponents, inner, most)
        beta, gamma = fit_location_and_scale(
            phi[:, k] * psi[:, j],
            prefixes,
            noise,
            sizes[:degrees],
            y,
            test,
            log_scale=log_scale,
            num_iterations=3,
        )
        log_sigma = noise @ gamma
        z = (y - (phi[:, k] * psi[:, j]) @ beta) / log_sigma.exp()
        z = z.clamp(-5.0, 5.0)  # few wild rows must not set the correlations
        correlation = torch.corrcoef(z.T).reshape(y.shape[1], -1).nan_to_num(0.0)
        correlation.fill_diagonal_(1.0)
        eye = torch.eye(y.shape[1], dtype=y.dtype)
        root = torch.linalg.cholesky(0.999 * correlation + 0.001 * eye)
        dense = y.new_zeros(len(exponents), len(inner), y.shape[1])
        dense[k, j] = beta
        used = dense.ne(0).any(-1).any(0)
        used[: 1 + dim] = True
        self.parameter_basis = Polynomials(u, inner[used])
        self.register_buffer("beta", dense[:, used])
        self.register_buffer("gamma", gamma)
        self.register_buffer("log_low", log_sigma.min(0).values)
        self.register_buffer("log_high", log_sigma.max(0).values)
        self.register_buffer(
            "whitener", torch.linalg.solve_triangular(root, eye, upper=False)
        )
        self.register_buffer("centers", u[~test][:NUM_CENTERS].clone())

        self.residual_scaling: ActionScaling | None = None
        some = slice(NUM_SCALING_ROWS if kind == "curved" else None)
        frames = self(y[some], action[some])
        v = nearest(local(u[some], frames), frames)
        self.residual_scaling = ActionScaling(v, action[some])

    def forward(self, y: Tensor, action: Tensor) -> Frames:
        """Return the frames of outcomes (n, m) and actions (n, action_dim)."""
        blocks = zip(y.split(BLOCK), action.split(BLOCK), strict=True)
        parts = zip(*(self._frames(*block) for block in blocks), strict=True)
        return Frames(*(torch.cat(part) for part in parts))

    def bend(self, u: Tensor, y: Tensor, action: Tensor) -> float:
        """Return the fraction of the held-out residual that u's powers explain.

        Args:
            u: Shape (n, d), as in the fit.
            y: Shape (n, m), as in the fit.
            action: Shape (n, action_dim), as in the fit.
        """
        test = held_out(len(u))
        phi = self.action_basis(action)
        predicted = torch.einsum(
            "nk,kjm,nj->nm", phi, self.beta, self.parameter_basis(u)
        )
        z = (y - predicted) / (phi[:, : len(self.gamma)] @ self.gamma).exp()
        z = z.clamp(-5.0, 5.0)
        few = phi[:, : max(4, 1 + action.shape[1])]
        most = int((~test).sum()) // (10 * few.shape[1])
        exponents, sizes = exponents_of(
            u, max_degree=3, max_terms=max(1, min(40, most))
        )
        design = Polynomials(u, exponents)(u)[..., None] * few[:, None]
        design = design.flatten(1)
        sizes = [size * few.shape[1] for size in sizes]
        left = z[test] - design[test] @ best_prefix(design, sizes, z, test)
        return float((1 - left.square().mean(0) / z[test].square().mean(0)).max())

    def _frames(self, y: Tensor, action: Tensor) -> Frames:
        phi = self.action_basis(action)
        log_sigma = phi[:, : len(self.gamma)] @ self.gamma
        log_sigma = torch.minimum(torch.maximum(log_sigma, self.log_low), self.log_high)
        # From here on outcomes are in units of their noise, which is N(0, I).
        whitener = self.whitener / log_sigma.exp()[:, None, :]
        y = (whitener @ y[..., None])[..., 0]
        beta = (phi @ self.beta.flatten(1)).unflatten(1, self.beta.shape[1:])
        beta = beta @ whitener.mT
        if self.kind == "linear":
            start = torch.zeros_like(self.centers[:1]).expand(len(y), 1, -1)
            misfit, gradient, precision = self._expand(start, y, beta)
            mean = start - torch.linalg.solve(precision, gradient)
            # No clamp to the rows' range here: the linear f holds everywhere.
            misfit = misfit + 0.5 * (gradient * (mean - start)).sum(-1)
        else:
            mean, misfit, precision = self._minimize(y, beta)
        factor = _cholesky(precision).mT
        if self.residual_scaling is not None:
            location, scale = self.residual_scaling.location_and_scale(action)
            location = location[:, None, :, None]
            step = torch.linalg.solve_triangular(factor, location, upper=True)
            mean, factor = mean + step[..., 0], factor / scale[:, None, :, None]
        return Frames(mean, factor, misfit)

    def _minimize(self, y: Tensor, beta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return solution, misfit and precision of two starts a row."""
        residual = y[:, None] - self.parameter_basis(self.centers) @ beta
        misfit = 0.5 * (residual.square().sum(-1) + self.centers.square().sum(-1))
        first = self._descend(self.centers[misfit.argmin(1)][:, None], y, beta)
        # Of the quadratic around the first solution, the centers' distances to it.
        step = self.centers - first[0]
        quadratic = (step * (step @ first[2][:, 0])).sum(-1) * 0.5 + first[1]
        second = (misfit.log() - quadratic.clamp_min(1e-12).log()).argmin(1)
        second = self._descend(self.centers[second][:, None], y, beta)
        mean, misfit, precision = (
            torch.cat(pair, 1) for pair in zip(first, second, strict=True)
        )
        return mean, misfit, precision

    def _descend(
        self, u: Tensor, y: Tensor, beta: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Take damped Gauss-Newton steps, each accepted where it improves."""
        low = self.parameter_basis.center - self.parameter_basis.half_width
        high = self.parameter_basis.center + self.parameter_basis.half_width
        damping = torch.full_like(u[..., :1], INITIAL_DAMPING)
        state = (u, *self._expand(u, y, beta))
        rows = torch.arange(len(u), device=u.device)  # not yet at rest
        for _ in range(NUM_STEPS):
            u, misfit, gradient, precision = (each[rows] for each in state)
            diagonal = precision.diagonal(dim1=-2, dim2=-1)
            damped = precision + torch.diag_embed(damping * diagonal)
            proposed = u - torch.linalg.solve(damped, gradient)
            proposed = torch.minimum(torch.maximum(proposed, low), high)
            new = (proposed, *self._expand(proposed, y[rows], beta[rows]))
            better = new[1] < misfit
            state = tuple(
                each.index_put((rows,), torch.where(_like(better, b), b, a))
                for each, a, b in zip(
                    state, (u, misfit, gradient, precision), new, strict=True
                )
            )
            restless = ~(better & (misfit - new[1] < AT_REST)).all(1)
            damping = torch.where(better[..., None], 0.1 * damping, 10.0 * damping)
            rows, damping = rows[restless], damping[restless]
            if not len(rows):
                break
        return state[0], state[1], state[3]

    def _expand(
        self, u: Tensor, y: Tensor, beta: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return misfit (n, J), its gradient (n, J, d) and Gauss-Newton Hessian."""
        psi, slope = self.parameter_basis.with_jacobian(u)
        residual = y[:, None] - psi @ beta
        jacobian = slope.mT @ beta[:, None]  # (n, J, d, m)
        misfit = 0.5 * (residual.square().sum(-1) + u.square().sum(-1))
        gradient = u - (jacobian @ residual[..., None])[..., 0]
        eye = torch.eye(u.shape[-1], dtype=u.dtype, device=u.device)
        return misfit, gradient, eye + jacobian @ jacobian.mT


def _cholesky(precision: Tensor) -> Tensor:
    """Return the lower factor of I + J J^T, which rounding may have made indefinite.

    That happens where noise is extrapolated to nearly nothing; a share of the largest
    entry, raised until it suffices, then stands for the lost I.
    """
    factor, info = torch.linalg.cholesky_ex(precision)
    share = 1e-14
    while bool(info.any()):
        largest = precision.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
        lifted = precision + torch.diag_embed(
            (share * largest).expand_as(factor[..., 0])
        )
        lost = (info > 0)[..., None, None]
        factor, info = torch.linalg.cholesky_ex(torch.where(lost, lifted, precision))
        share *= 10.0
    return factor


def local(u: Tensor, frames: Frames) -> Tensor:
    """Return v in every frame, (..., n, d) -> (..., n, J, d)."""
    step = u[..., None, :] - frames.mean
    return (frames.factor * step[..., None, :]).sum(-1)


def nearest(v: Tensor, frames: Frames) -> Tensor:
    """Return v in the frame of highest density, (n, J, d) -> (n, d)."""
    log_density = frames.log_det - 0.5 * v.square().sum(-1)
    return v[torch.arange(len(v)), log_density.argmax(1)]


def _like(mask: Tensor, values: Tensor) -> Tensor:
    return mask.reshape(*mask.shape, *[1] * (values.ndim - mask.ndim))


def _joint_terms(
    outer: Tensor, inner: Tensor, most: int
) -> tuple[Tensor, Tensor, list[int]]:
    """Return pairs of exponents from coarse to fine, and numbers to choose from.

    Terms linear in u come with every polynomial of the action; for others, degrees of
    action and parameters add up against one bound.
    """
    outer_degree, inner_degree = outer.sum(1), inner.sum(1)
    ratio = MAX_DEGREE / max(int(outer_degree.max()), 1)
    joint = (inner.ne(0).sum(1) - 1).clamp_min(0) * JOINT_COST
    cost = outer_degree[:, None] * ratio + (inner_degree + joint)[None]
    order = cost.flatten().argsort(stable=True)[:most]
    costs = cost.flatten()[order]
    levels = torch.linspace(1.0, float(costs[-1]), 9).tolist()
    prefixes = sorted({int((costs <= level).sum()) for level in levels})
    return order // len(inner), order % len(inner), prefixes
