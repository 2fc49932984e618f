"""Regression of the outcome on action and parameters by polynomials, and its noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import combinations_with_replacement
from typing import Literal

import torch
from torch import Tensor, nn

LOG_NORMAL_MEAN = 0.6351814227  # -E log|e| of a standard normal e
SMALLEST_SCALE = 1e-6  # of the scale over all actions: float32 ends there


class Polynomials(nn.Module):
    r"""Products of Chebyshev polynomials, in the order of their total degree.

    .. math::
        \phi_j(r) = \prod_i T_{j_i}\!\left(\frac{r_i - c_i}{h_i}\right), \qquad
        |j| = \sum_i j_i

    with center c and half-width h from the smallest and largest numbers of the rows.
    Rows further out are moved to the edge, since nothing was seen there.

    Args:
        rows: Rows of numbers, shape (n, d).
        exponents: :math:`j`, shape (p, d).
    """

    def __init__(self, rows: Tensor, exponents: Tensor) -> None:
        super().__init__()
        low, high = rows.min(0).values.double(), rows.max(0).values.double()
        half = 0.5 * (high - low)
        self.center = nn.Buffer(0.5 * (high + low))
        self.half_width = nn.Buffer(torch.where(half > 0, half, 1.0))
        self.exponents = nn.Buffer(exponents)

    def forward(self, rows: Tensor) -> Tensor:
        """Return the polynomials, (..., d) -> (..., p)."""
        return _product(self._factors(self._chebyshev(self._scaled(rows))))

    def with_jacobian(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the polynomials (..., p) and their derivatives (..., p, d)."""
        scaled = self._scaled(rows)
        values = self._chebyshev(scaled)
        slopes = [torch.zeros_like(scaled), torch.ones_like(scaled)]
        while len(slopes) < values.shape[-1]:  # T'_{k+1} = 2 T_k + 2 w T'_k - T'_{k-1}
            k = len(slopes) - 1
            slopes.append(2 * values[..., k] + 2 * scaled * slopes[-1] - slopes[-2])
        slope = torch.stack(slopes[: values.shape[-1]], -1)
        factors, slopes = self._factors(values), self._factors(slope)
        derivatives = [
            _product([own / width, *factors[:i], *factors[i + 1 :]])
            for i, (own, width) in enumerate(zip(slopes, self.half_width, strict=True))
        ]
        return _product(factors), torch.stack(derivatives, -1)

    def _scaled(self, rows: Tensor) -> Tensor:
        return ((rows.double() - self.center) / self.half_width).clamp(-1.0, 1.0)

    def _chebyshev(self, scaled: Tensor) -> Tensor:
        values = [torch.ones_like(scaled), scaled]
        for _ in range(int(self.exponents.max()) - 1):
            values.append(2 * scaled * values[-1] - values[-2])
        return torch.stack(values, -1)

    def _factors(self, values: Tensor) -> list[Tensor]:
        """Return the polynomial of each number in every product, (..., p) each."""
        pairs = zip(values.unbind(-2), self.exponents.unbind(-1), strict=True)
        return [each.index_select(-1, exponent) for each, exponent in pairs]


def _product(factors: Sequence[Tensor]) -> Tensor:
    return reduce(torch.mul, factors)


def exponents_of(
    rows: Tensor, *, max_degree: int, max_terms: int
) -> tuple[Tensor, list[int]]:
    """Return exponents (p, d), and the number of terms up to each total degree.

    No number gets a degree that its distinct values could not tell from a lower one.
    """
    dim = rows.shape[1]
    caps = [len(rows[:, i].unique()) - 1 for i in range(dim)]
    terms, sizes = [[0] * dim], [1]
    for degree in range(1, max_degree + 1):
        drawn = combinations_with_replacement(range(dim), degree)
        new = [[chosen.count(i) for i in range(dim)] for chosen in drawn]
        new = [e for e in new if all(k <= cap for k, cap in zip(e, caps, strict=True))]
        if not new or len(terms) + len(new) > max_terms:
            break
        terms += new
        sizes.append(len(terms))
    return torch.tensor(terms), sizes


def held_out(num_rows: int) -> Tensor:
    """Return a mask of a fifth of the rows, the same at each call."""
    order = torch.randperm(num_rows, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(num_rows, dtype=torch.bool)
    mask[order[: num_rows // 5]] = True
    return mask


def fit_location_and_scale(
    design: Tensor,
    sizes: Sequence[int],
    noise_design: Tensor,
    noise_sizes: Sequence[int],
    y: Tensor,
    test: Tensor,
    *,
    num_iterations: int = 3,
) -> tuple[Tensor, Tensor]:
    r"""Regress location and scale of y by iterated weighted least squares.

    .. math::
        y = F \beta + \sigma e, \quad \log \sigma = G \gamma, \quad
        \hat\beta = \arg\min_\beta \sum_n (y_n - F_n \beta)^2 / \sigma_n^2, \quad
        \hat\gamma = \arg\min_\gamma \sum_n (\log |y_n - F_n \hat\beta| + c
        - G_n \gamma)^2,

    the second of which gives the weights of the next first; the distance of y from its
    median gives the first ones. Both use the leading
    columns of their design that predict the held-out rows best.

    Args:
        design: F, shape (n, p), columns from coarse to fine.
        sizes: Numbers of leading columns to choose from.
        noise_design: G, shape (n, q), its first column one.
        noise_sizes: Numbers of leading columns of G to choose from.
        y: Shape (n, m).
        test: Mask of held-out rows, shape (n,).
        num_iterations: Number of iterations of the pair of regressions (a choice).

    Returns:
        beta, shape (p, m), and gamma, shape (q, m).
    """
    floor = SMALLEST_SCALE * y.std(0, correction=0).clamp_min(1e-30)
    beta, residual = y.new_zeros(design.shape[1], y.shape[1]), y - y.median(0).values
    gamma = _fit_log_scale(noise_design, noise_sizes, residual, floor, test)
    for _ in range(num_iterations):
        log_scale = torch.maximum(noise_design @ gamma, floor.log())
        beta = _least_squares(design, sizes, y, log_scale, test)
        residual = y - design @ beta
        gamma = _fit_log_scale(noise_design, noise_sizes, residual, floor, test)
    return beta, gamma


def _fit_log_scale(
    design: Tensor, sizes: Sequence[int], residual: Tensor, floor: Tensor, test: Tensor
) -> Tensor:
    size = residual.abs().clamp_min(floor)
    log_size = size.log() + LOG_NORMAL_MEAN
    gamma = _least_squares(design, sizes, log_size, torch.zeros_like(size), test)
    z = (log_size - LOG_NORMAL_MEAN - design @ gamma).exp()
    # The root mean square becomes one.
    gamma[0] += 0.5 * _tamed(z, z.median(0).values).square().mean(0).log()
    return gamma


def _least_squares(
    design: Tensor,
    sizes: Sequence[int],
    y: Tensor,
    log_scale: Tensor,
    test: Tensor,
    *,
    same: float = 0.5,
) -> Tensor:
    """Weighted least squares, columns of nearly the same weights together."""
    beta = y.new_zeros(design.shape[1], y.shape[1])
    shape = log_scale - log_scale.mean(0)
    todo = list(range(y.shape[1]))
    while todo:
        near = (shape[:, todo] - shape[:, todo[:1]]).square().mean(0).sqrt()
        group = [j for j, r in zip(todo, near.tolist(), strict=True) if r < same]
        group = group or todo[:1]
        todo = [j for j in todo if j not in group]
        weight = (-shape[:, group].mean(1, keepdim=True)).exp()
        beta[:, group] = best_prefix(design * weight, sizes, y[:, group] * weight, test)
    return beta


def _tamed(size: Tensor, median: Tensor, *, wild: float = 10.0) -> Tensor:
    """Return sizes in which those beyond so many medians count as that many."""
    return torch.minimum(size, wild * median)


def best_prefix(
    design: Tensor, sizes: Sequence[int], y: Tensor, test: Tensor
) -> Tensor:
    """Least squares by QR, on the leading columns that predict held-out rows best."""
    p, m = design.shape[1], y.shape[1]
    # The R of [F, y] holds Q'y in its last columns. A trace of ridge, for the rank.
    norm = design.norm(dim=0).clamp_min(1e-300)
    ridge = torch.cat([torch.diag(1e-8 * norm), y.new_zeros(p, m)], 1)
    rows = torch.cat([design, y], 1)
    unseen, seen = rows[test], rows[~test]
    factor = torch.linalg.qr(torch.cat([seen, ridge]), mode="r").R
    best, beta = torch.full((m,), torch.inf, dtype=y.dtype), y.new_zeros(p, m)
    for size in sizes:
        solution = torch.linalg.solve_triangular(
            factor[:size, :size], factor[:size, p:], upper=True
        )
        error = (unseen[:, p:] - unseen[:, :size] @ solution).abs()
        error = _tamed(error, error.median(0).values.clamp_min(1e-300))
        error = error.square().mean(0)
        better = error < 0.999 * best
        beta = torch.where(better, 0.0, beta)
        beta[:size] = torch.where(better, solution, beta[:size])
        best = torch.where(better, error, best)
    return beta


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
