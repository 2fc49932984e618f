"""Location and scale of numbers as smooth functions of the action."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import combinations_with_replacement

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
        derivatives = []
        for i, slope in enumerate(slopes):
            others = factors[:i] + factors[i + 1 :]
            derivatives.append(_product([slope / self.half_width[i], *others]))
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
        return [
            each.index_select(-1, exponent)
            for each, exponent in zip(
                values.unbind(-2), self.exponents.unbind(-1), strict=True
            )
        ]


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
        new = [
            exponent
            for combination in combinations_with_replacement(range(dim), degree)
            if all(
                (exponent := [combination.count(i) for i in range(dim)])[i] <= caps[i]
                for i in range(dim)
            )
        ]
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
    num_iterations: int = 4,
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
    beta = y.new_zeros(0)
    floor = SMALLEST_SCALE * y.std(0, correction=0).clamp_min(1e-30)
    ones = torch.zeros_like(y)
    around_median = y - y.median(0).values
    gamma = _fit_log_scale(noise_design, noise_sizes, around_median, floor, test)
    log_scale = noise_design @ gamma
    for _ in range(num_iterations):
        beta = _least_squares(design, sizes, y, log_scale, test)
        residual = y - design @ beta
        gamma = _fit_log_scale(noise_design, noise_sizes, residual, floor, test)
        log_scale = torch.maximum(noise_design @ gamma, floor.log() + ones)
    return beta, gamma


def _fit_log_scale(
    design: Tensor, sizes: Sequence[int], residual: Tensor, floor: Tensor, test: Tensor
) -> Tensor:
    size = residual.abs().clamp_min(floor)
    log_size = size.log() + LOG_NORMAL_MEAN
    gamma = _least_squares(design, sizes, log_size, torch.zeros_like(size), test)
    z = (log_size - LOG_NORMAL_MEAN - design @ gamma).exp()
    gamma[0] += (
        0.5 * _tamed(z, z.median(0).values).square().mean(0).log()
    )  # the root mean square becomes one
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


class ActionScaling(nn.Module):
    r"""Numbers standardized given the action.

    .. math::
        \tilde y = \frac{y - \mu(\xi)}{\sigma(\xi)}, \qquad
        \mu, \log \sigma \text{ polynomials of } \xi

    of the degree that predicts held-out rows best. With one action it is the usual
    z-score.

    Args:
        y: Shape (n, m), finite.
        action: Actions, shape (n, action_dim).
        max_degree: Largest degree that held-out rows choose from: Chebyshev polynomials
            of degree 16 have 16 zeros over the actions.
        max_noise_degree: Largest degree of the noise.
    """

    def __init__(
        self,
        y: Tensor,
        action: Tensor,
        *,
        max_degree: int = 16,
        max_noise_degree: int = 8,
    ) -> None:
        super().__init__()
        y, test = y.double(), held_out(len(y))
        mean, scale = y.mean(0), y.std(0, correction=0)
        scale = torch.where(scale > 1e-12 * (1.0 + mean.abs()), scale, 1.0)
        most = max(1, int((~test).sum()) // 10)
        exponents, sizes = exponents_of(action, max_degree=max_degree, max_terms=most)
        self.polynomials = Polynomials(action, exponents)
        design = self.polynomials(action)
        degrees = min(len(sizes), max_noise_degree + 1)
        noise = design[:, : sizes[degrees - 1]]
        beta, gamma = fit_location_and_scale(
            design, sizes, noise, sizes[:degrees], (y - mean) / scale, test
        )
        log_scale = (noise @ gamma).clamp_min(math.log(SMALLEST_SCALE))
        self.mean = nn.Buffer(mean)
        self.scale = nn.Buffer(scale)
        self.beta = nn.Buffer(beta)
        self.gamma = nn.Buffer(gamma)
        self.log_low = nn.Buffer(log_scale.min(0).values)
        self.log_high = nn.Buffer(log_scale.max(0).values)

    def location_and_scale(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale of y, each (n, m), in float64."""
        design = self.polynomials(action)
        log_scale = design[:, : len(self.gamma)] @ self.gamma
        log_scale = log_scale.clamp(self.log_low, self.log_high)
        location = self.mean + self.scale * (design @ self.beta)
        return location, self.scale * log_scale.exp()

    def forward(self, y: Tensor, action: Tensor) -> Tensor:
        """Return y standardized, (n, m) and (n, action_dim) -> (n, m), in float64."""
        location, scale = self.location_and_scale(action)
        return (y.double() - location) / scale
