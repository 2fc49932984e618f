"""Regression of the outcome on action and parameters, with a noise of the action's."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn

from sbi_active.inference.networks.polynomials import (
    SMALLEST_SCALE,
    Polynomials,
    best_prefix,
    exponents_of,
    fit_location_and_scale,
    held_out,
)


class Response(nn.Module):
    r"""Polynomial regression of the outcome on the action and whitened parameters u.

    .. math::
        x = f(\xi, u) + e, \qquad f = \sum_{kj} \beta_{kj}\, \phi_k(\xi)\, \psi_j(u),
        \qquad e \sim \mathcal N(0, S(\xi)), \quad S = \Sigma R\, \Sigma,

    with :math:`\Sigma(\xi)` diagonal, its logarithm a polynomial, and correlations R.
    "linear" has :math:`\psi = (1, u)`, "curved" powers up to the ninth.

    Args:
        u: Whitened parameters, shape (n, d).
        y: Finite outcomes, of scale one over all actions, shape (n, m).
        action: Actions, shape (n, action_dim).
        kind: Whether f is linear in u.
        max_degree: Largest degree of the parameters.
        max_features: Number of features of action and parameters at most.
        max_action_degree: Largest degree of the action that held-out rows choose from.
        max_noise_degree: Largest degree of the noise.
    """

    def __init__(
        self,
        u: Tensor,
        y: Tensor,
        action: Tensor,
        *,
        kind: Literal["linear", "curved"],
        max_degree: int = 9,
        max_features: int = 260,
        max_action_degree: int = 14,
        max_noise_degree: int = 8,
    ) -> None:
        super().__init__()
        self.kind = kind
        test = held_out(len(u))
        num_train, dim = int((~test).sum()), u.shape[1]
        most = min(max_features, num_train // 8)
        exponents, sizes = exponents_of(
            action, max_degree=max_action_degree, max_terms=max(1, most // (1 + dim))
        )
        degree = max_degree if kind == "curved" else 1
        # A degree more than there is data for costs nothing: terms are cut off below.
        inner, _ = exponents_of(u, max_degree=degree, max_terms=max(1 + dim, most))
        self.action_basis = Polynomials(action, exponents)
        phi, psi = self.action_basis(action), Polynomials(u, inner)(u)
        degrees = min(len(sizes), max_noise_degree + 1)
        noise = phi[:, : sizes[degrees - 1]]
        k, j, prefixes = _joint_terms(exponents, inner, most, max_degree)
        design = phi[:, k] * psi[:, j]
        beta, gamma = fit_location_and_scale(
            design, prefixes, noise, sizes[:degrees], y, test
        )
        # Between rows that lie apart a polynomial may dive to any depth.
        floor = SMALLEST_SCALE * y.std(0, correction=0).clamp_min(SMALLEST_SCALE)
        log_sigma = torch.maximum(noise @ gamma, floor.log())
        z = (y - design @ beta) / log_sigma.exp()
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
        self.beta = nn.Buffer(dense[:, used])
        self.gamma = nn.Buffer(gamma)
        self.log_low = nn.Buffer(log_sigma.min(0).values)
        self.log_high = nn.Buffer(log_sigma.max(0).values)
        self.whitener = nn.Buffer(torch.linalg.solve_triangular(root, eye, upper=False))

    @staticmethod
    def best(u: Tensor, y: Tensor, action: Tensor) -> Response:
        """Return the linear or the curved regression, by held-out log score.

        The curved one has many more coefficients to fit, so its gain must be beyond
        chance.
        """
        linear = Response(u, y, action, kind="linear")
        if not linear.bends(u, y, action):
            return linear
        curved = Response(u, y, action, kind="curved")
        test = held_out(len(u))
        rows = u[test], y[test], action[test]
        gain = curved.log_prob(*rows) - linear.log_prob(*rows)
        return curved if exceeds_chance(gain) else linear

    @staticmethod
    def marginal(y: Tensor, action: Tensor) -> Response:
        """Return the regression on the action alone, of parameters that never vary."""
        return Response(y.new_zeros(len(y), 1), y, action, kind="linear")

    def location_and_scale(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return f at the middle of the parameters, and the noise, each (n, m)."""
        phi = self.action_basis(action)
        return phi @ self.beta[:, 0], self._log_sigma(phi).exp()

    def _log_sigma(self, phi: Tensor) -> Tensor:
        log_sigma = phi[:, : len(self.gamma)] @ self.gamma
        return log_sigma.clamp(self.log_low, self.log_high)

    def weights(self, action: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the whitener of an action's noise, and f's weights.

        They are a root of :math:`S^{-1}`, shape (n, m, m), and :math:`\beta` for
        :math:`\psi(u)`, in the outcome's own units, shape (n, p, m).
        """
        phi = self.action_basis(action)
        whitener = self.whitener / self._log_sigma(phi).exp()[:, None, :]
        return whitener, (phi @ self.beta.flatten(1)).unflatten(1, self.beta.shape[1:])

    def mean_and_whitener(self, u: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return f, shape (n, m), and the noise's whitener, shape (n, m, m)."""
        whitener, beta = self.weights(action)
        return (self.parameter_basis(u)[:, None] @ beta)[:, 0], whitener

    def standardize(
        self, u: Tensor, y: Tensor, action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return residuals over the noise (n, m) and their log |dz / dy| (n,)."""
        mean, whitener = self.mean_and_whitener(u, action)
        z = (whitener @ (y - mean)[..., None])[..., 0]
        return z, whitener.diagonal(dim1=-2, dim2=-1).log().sum(-1)

    def log_prob(self, u: Tensor, y: Tensor, action: Tensor) -> Tensor:
        """Return the Gaussian log density of outcomes, shape (n,)."""
        z, log_det = self.standardize(u, y, action)
        return log_det + log_normal(z)

    def bends(
        self, u: Tensor, y: Tensor, action: Tensor, *, straight: float = 0.01
    ) -> bool:
        """Return whether powers of u explain more than a share of held-out residuals.

        Below that f is taken to be linear.
        """
        test = held_out(len(u))
        z = self.standardize(u, y, action)[0].clamp(-5.0, 5.0)
        few = self.action_basis(action)[:, : max(4, 1 + action.shape[1])]
        most = int((~test).sum()) // (10 * few.shape[1])
        exponents, sizes = exponents_of(
            u, max_degree=3, max_terms=max(1, min(40, most))
        )
        design = (Polynomials(u, exponents)(u)[..., None] * few[:, None]).flatten(1)
        sizes = [size * few.shape[1] for size in sizes]
        left = z[test] - design[test] @ best_prefix(design, sizes, z, test)
        share = (1 - left.square().mean(0) / z[test].square().mean(0)).max()
        return float(share) > straight


def log_normal(u: Tensor) -> Tensor:
    """Return the log density of the standard normal, (..., d) -> (...)."""
    return -0.5 * u.square().sum(-1) - 0.5 * u.shape[-1] * math.log(2 * math.pi)


def exceeds_chance(gain: Tensor) -> bool:
    """Return whether a mean is above three of its standard errors, (n,) -> bool."""
    return bool(gain.mean() > 3 * gain.std() / math.sqrt(len(gain)))


def _joint_terms(
    outer: Tensor, inner: Tensor, most: int, max_degree: int, *, joint_cost: float = 1.5
) -> tuple[Tensor, Tensor, list[int]]:
    """Return pairs of exponents from coarse to fine, and numbers to choose from.

    Terms linear in u come with every polynomial of the action; for others, degrees of
    action and parameters add up against one bound.
    """
    outer_degree, inner_degree = outer.sum(1), inner.sum(1)
    ratio = max_degree / max(int(outer_degree.max()), 1)
    joint = (inner.ne(0).sum(1) - 1).clamp_min(0) * joint_cost
    cost = outer_degree[:, None] * ratio + (inner_degree + joint)[None]
    order = cost.flatten().argsort(stable=True)[:most]
    costs = cost.flatten()[order]
    levels = torch.linspace(1.0, float(costs[-1]), 9).tolist()
    prefixes = sorted({int((costs <= level).sum()) for level in levels})
    return order // len(inner), order % len(inner), prefixes
