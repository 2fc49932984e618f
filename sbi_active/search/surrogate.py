r"""A smooth regression of the utility on the action."""

from __future__ import annotations

import math

import torch
from torch import Tensor

NUM_STEPS = 40  # of the optimizer of the hyperparameters
#: Means and standard deviations of the logarithms' priors, in a unit cube and for
#: values of unit variance.
LENGTH_PRIOR = (math.log(0.4), 1.0)
AMPLITUDE_PRIOR = (0.0, 1.0)
NUGGET = 1e-5  # of the values' variance, for the factorization
LIMIT = 4.0  # of the logarithms, beyond which a line search may not step


class Surrogate:
    r"""Gaussian-process regression on points of a unit cube and categories.

    .. math::
        k(z, z') = \sigma^2 \left(1 + \sqrt5 r + \tfrac53 r^2\right) e^{-\sqrt5 r}
        \prod_j \rho_j^{[k_j \ne k'_j]}, \qquad
        r^2 = \sum_i (u_i - u'_i)^2 / \ell_i^2

    (Matern 5/2), its hyperparameters by maximum a posteriori. The errors of the values
    are known but for a factor below one: values from common random numbers err
    together, which a smooth function of the action absorbs.

    Args:
        point: Shape (n, c + number of categories).
        value: Shape (n,).
        error: Standard errors of the values, shape (n,).
        num_continuous: c.

    References:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006.
    """

    def __init__(
        self, point: Tensor, value: Tensor, error: Tensor, *, num_continuous: int
    ) -> None:
        self._c = num_continuous
        self._point = point.double()
        self.center = value.double().mean()
        # values that agree by common random numbers vary by less than they err
        floor = 1e-3 * float(error.mean()) + 1e-12
        self.scale = value.double().std().clamp_min(floor)
        self._value = (value.double() - self.center) / self.scale
        self._error = error.double() / self.scale
        num_categories = point.shape[1] - num_continuous
        start = [LENGTH_PRIOR[0]] * num_continuous + [0.0] * num_categories
        free = torch.tensor([*start, 0.0, 0.0], dtype=torch.float64)
        free.requires_grad_(True)
        optimizer = torch.optim.LBFGS(
            [free], max_iter=NUM_STEPS, line_search_fn="strong_wolfe"
        )

        def loss() -> Tensor:
            with torch.enable_grad():
                optimizer.zero_grad()
                value = self._loss(free)
                value.backward()
                return value

        optimizer.step(loss)  # pyright: ignore[reportArgumentType]
        self._free = free.detach().nan_to_num(0.0)
        with torch.no_grad():
            self._factor = self._cholesky(self._free)
            self._weight = torch.cholesky_solve(self._value[:, None], self._factor)

    def __call__(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation at points (m, dim), both (m,)."""
        cross = self._kernel(self._free, point, self._point)
        white = torch.linalg.solve_triangular(self._factor, cross.mT, upper=False)
        amplitude = self._free[-2].clamp(-LIMIT, LIMIT).exp()
        variance = amplitude.square() - white.square().sum(0)
        mean = (cross @ self._weight)[:, 0]
        return self.center + self.scale * mean, self.scale * _root(variance)

    def covariance(self, point: Tensor) -> Tensor:
        """Return the posterior covariance of points (m, dim), shape (m, m)."""
        cross = self._kernel(self._free, point, self._point)
        white = torch.linalg.solve_triangular(self._factor, cross.mT, upper=False)
        own = self._kernel(self._free, point, point)
        return self.scale.square() * (own - white.mT @ white)

    def influence(self, point: Tensor) -> Tensor:
        r"""Return what each value adds to the mean, shape (m, n).

        :math:`k(z, Z) K^{-1}` times the residual of the value. Their root of the sum of
        squares is a standard error that does not assume the values' errors.
        """
        cross = self._kernel(self._free, point, self._point)
        smoother = torch.cholesky_solve(cross.mT, self._factor).mT
        fitted = self._kernel(self._free, self._point, self._point) @ self._weight
        return self.scale * smoother * (self._value - fitted[:, 0])

    def _kernel(self, free: Tensor, z: Tensor, other: Tensor) -> Tensor:
        c = self._c
        free = free.clamp(-LIMIT, LIMIT)
        apart = (z[:, None, :c] - other[None, :, :c]) / free[:c].exp()
        r = _root(5 * apart.square().sum(-1))
        log_k = 2 * free[-2] + (1 + r + r.square() / 3).log() - r
        differs = (z[:, None, c:] != other[None, :, c:]).double()
        rho = torch.nn.functional.logsigmoid(free[c:-2])
        return (log_k + differs @ rho).exp()

    def _cholesky(self, free: Tensor) -> Tensor:
        share = free[-1].clamp(-2 * LIMIT, LIMIT).sigmoid()
        noise = share * self._error.square() + NUGGET
        kernel = self._kernel(free, self._point, self._point)
        return torch.linalg.cholesky(kernel + noise.diag())

    def _loss(self, free: Tensor) -> Tensor:
        factor = self._cholesky(free)
        white = torch.linalg.solve_triangular(factor, self._value[:, None], upper=False)
        fit = 0.5 * white.square().sum() + factor.diagonal().log().sum()
        length = (free[: self._c] - LENGTH_PRIOR[0]) / LENGTH_PRIOR[1]
        amplitude = (free[-2] - AMPLITUDE_PRIOR[0]) / AMPLITUDE_PRIOR[1]
        others = free[self._c : -2].square().sum() + free[-1].square()
        prior = length.square().sum() + amplitude.square() + others / 4
        return fit + 0.5 * prior


def _root(square: Tensor) -> Tensor:
    """Square root with a finite gradient at zero."""
    return (square.clamp_min(0.0) + 1e-12).sqrt()
