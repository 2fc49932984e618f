r"""Gaussian processes: of outcomes on few simulations, and of a utility on actions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from scipy.optimize import minimize
from torch import Tensor

from sbi_active.arrays import Array

Kind = Literal["smooth", "rough"]


@dataclass(frozen=True, kw_only=True)
class ProcessSettings:
    """Settings of a Gaussian process.

    Means and deviations are those of logarithms a priori, for inputs of about unit size
    and outputs of unit variance.

    Attributes:
        kind: Kernel, a squared exponential ("smooth") or Matern 5/2 ("rough").
        degree: Degree of the trend, 0 for none; None takes a quadratic one where rows
            are twice its features, which of many inputs and much noise is too many.
        trend: Deviation of the trend's coefficients.
        length: Mean and deviation of the log length of each input.
        amplitude: Mean and deviation of the log amplitude.
        noise: Mean and deviation of the log standard deviation of learned noise.
        jitter: Variance that is always added; a noise below its root is not resolved.
        limit: Absolute value beyond which a line search may not step.
        num_steps: Number of steps of the optimizer of the hyperparameters.
    """

    kind: Kind = "smooth"
    degree: Literal[0, 1, 2] | None = None
    trend: float = 3.0
    length: tuple[float, float] = (math.log(2.5), 1.0)
    amplitude: tuple[float, float] = (math.log(0.5), 1.5)
    noise: tuple[float, float] = (math.log(0.3), 1.5)
    jitter: float = 1e-7
    limit: float = 6.0
    num_steps: int = 25


#: Of values in a unit cube that all vary, without a trend.
IN_CUBE = ProcessSettings(
    kind="rough",
    degree=0,
    length=(math.log(0.4), 1.0),
    amplitude=(0.0, 1.0),
    noise=(0.0, 1.0),
    jitter=1e-5,
    limit=4.0,
    num_steps=40,
)


@dataclass(frozen=True)
class GaussianProcess:
    r"""Regression of outputs y (n, q) on inputs u (n, D), outputs sharing a kernel.

    .. math::
        k(u, u') = b^2 h(u)^\top h(u') + \sigma^2 \kappa(r)
        \prod_j \rho_j^{[c_j \ne c'_j]} + \tau^2 [u = u'], \qquad
        r^2 = \sum_i (u_i - u'_i)^2 / \ell_i^2,

    with h a linear or quadratic basis, c the categories among the inputs, which are the
    last, and the hyperparameters at their most probable values. Noise is none, learned,
    or known but for a factor below one: values from common random numbers err together,
    which a smooth function absorbs. Unless it is known the variance is scaled so that
    left-out rows are missed by as much as it says. If outputs have no noise, a
    least-squares trend is subtracted first: they may differ by 10,000 deviations of the
    noise declared beside them, and are to be known to one.

    Attributes:
        u: Inputs, shape (n, D).
        num_categories: Number of inputs that are categories.
        settings: Settings, with the degree that was taken.
        free: Logarithms of lengths, logits of :math:`\rho`, logarithms of
            :math:`\sigma` and of the noise, shape (D + 2,).
        noise: Variance of each row's noise, of outputs of unit size, shape (n,).
        values: Outputs of unit size beside the trend taken off, shape (n, q).
        precision: :math:`K^{-1}`, shape (n, n).
        shift: Mean of the outputs, shape (q,).
        taken_off: Coefficients of the trend taken off, shape (p, q).
        scale: Size of the outputs, shape (q,).
        inflation: Factor of the variance, shape (q,).
        log_evidence: Log evidence of the data and the hyperparameters.

    References:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, sections
        2.7 and 5.4.2.
    """

    u: Tensor
    num_categories: int
    settings: ProcessSettings
    free: Tensor
    noise: Tensor
    values: Tensor
    precision: Tensor
    shift: Tensor
    taken_off: Tensor
    scale: Tensor
    inflation: Tensor
    log_evidence: float

    @staticmethod
    def fit(
        u: Array | Tensor,
        y: Array | Tensor,
        *,
        noise: Literal["none", "learned"] | Tensor,
        num_categories: int = 0,
        settings: ProcessSettings | None = None,
        most_fitted: int = 250,
        spare_least: int = 3,
        rows_a_feature: float = 2.0,
        most_inflation: float = 16.0,
        rounded: float = 1e-7,
    ) -> GaussianProcess:
        """Return the process of inputs (n, D) and outputs (n, q), n >= 2.

        Args:
            u: Inputs.
            y: Outputs.
            noise: What is known of the noise of y: standard errors (n,), or that there
                is none, or that it is to be learned.
            num_categories: Number of inputs, the last ones, that are categories.
            settings: Kernel, trend and hyperpriors.
            most_fitted: Number of rows that hyperparameters are fitted to.
            spare_least: Number of rows beyond the features before a trend is taken off.
            rows_a_feature: Number of rows a feature that a quadratic trend takes at
                least.
            most_inflation: Factor of the variance at most, where left-out rows are
                missed by more.
            rounded: Share of the largest output that single precision does not tell.
        """
        settings = settings or ProcessSettings()
        u, y = torch.as_tensor(u).double(), torch.as_tensor(y).double()
        if settings.degree is None:
            enough = len(u) >= rows_a_feature * num_features(u.shape[1])
            settings = replace(settings, degree=2 if enough else 1)
        shift, size = y.mean(0), y.abs().amax(0)
        rest, scale = y - shift, y.std(0, correction=0)
        basis = _features(u, settings)
        taken_off = y.new_zeros(basis.shape[1], y.shape[1])
        spare = len(u) - basis.shape[1]
        if isinstance(noise, Tensor):
            # Values that agree by common random numbers vary by less than they err.
            scale = scale.clamp_min(1e-3 * float(noise.mean()) + 1e-12)
            noise = noise.double() / scale
        elif noise == "none" and spare >= spare_least:
            taken_off = torch.linalg.lstsq(basis, rest, driver="gelsd").solution
            rest = rest - basis @ taken_off
            spread = (rest.square().sum(0) / spare).sqrt()
            scale = torch.maximum(spread, (rounded * size).clamp_min(1e-30))
        else:
            scale = torch.where(scale > 1e-6 * size, scale, size.clamp_min(1e-30))
        values = rest / scale
        some = slice(None, None, max(1, -(-len(u) // most_fitted)))
        few = noise[some] if isinstance(noise, Tensor) else noise
        free, evidence = _hyperparameters(
            u[some], values[some], few, num_categories, settings
        )
        kernel = _Kernel(free, num_categories, settings)
        variance = kernel.noise(noise, len(u))
        precision = torch.linalg.inv(kernel(u, u) + variance.diag())
        precision = 0.5 * (precision + precision.mT)
        inflation = torch.ones_like(scale)
        if not isinstance(noise, Tensor):
            missed = (precision @ values).square() / precision.diagonal()[:, None]
            inflation = missed.mean(0).clamp(1.0, most_inflation)
        return GaussianProcess(
            *(u, num_categories, settings, free, variance, values, precision),
            *(shift, taken_off, scale, inflation, evidence),
        )

    @property
    def noise_sd(self) -> Array:
        r"""Standard deviation :math:`\tau` of learned noise in units of y, (q,)."""
        return (self.scale * (self.noise[0] * self.inflation).sqrt()).numpy()

    @property
    def left_out(self) -> Array:
        """Residuals of left-out rows in units of y, shape (n, q)."""
        missed = self.precision @ self.values / self.precision.diagonal()[:, None]
        return (missed * self.scale).numpy()

    @property
    def left_out_most(self) -> float:
        """Largest error of a left-out row in the deviations that are expected of it."""
        missed = (
            self.precision @ self.values / self.precision.diagonal().sqrt()[:, None]
        )
        return float((missed.abs() / self.inflation.sqrt()).max())

    def predict(self, u: Array) -> tuple[Array, Array]:
        """Return mean and variance without noise at inputs (m, D), both (m, q)."""
        mean, variance = self(torch.from_numpy(u))
        return mean.numpy(), variance.numpy()

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance at inputs (m, D), both (m, q), differentiably."""
        cross, trend = self._cross(u), _features(u, self.settings)
        own = trend.square().sum(1) + self._kernel.amplitude().square()
        variance = own - ((cross @ self.precision) * cross).sum(1)
        variance = variance.clamp_min(self.settings.jitter)[:, None] * self.inflation
        beside = cross @ (self.precision @ self.values)
        mean = self.shift + trend @ self.taken_off + beside * self.scale
        return mean, variance * self.scale**2

    def covariance(self, u: Tensor) -> Tensor:
        """Return the posterior covariance of the first output at (m, D), (m, m)."""
        cross = self._cross(u)
        own = self._kernel(u, u)
        return self.scale[0].square() * (own - cross @ self.precision @ cross.mT)

    @property
    def _kernel(self) -> _Kernel:
        return _Kernel(self.free, self.num_categories, self.settings)

    def _cross(self, u: Tensor) -> Tensor:
        return self._kernel(u, self.u)


def num_features(dim: int) -> int:
    """Return the features of a quadratic trend of so many inputs."""
    return 1 + dim + dim * (dim + 1) // 2


def _features(u: Tensor, settings: ProcessSettings) -> Tensor:
    """Return the trend's features times their deviations, shape (n, p)."""
    if settings.degree == 0:
        return u.new_zeros(len(u), 0)
    parts = [torch.ones(len(u), 1).to(u), u]
    if settings.degree == 2:
        row, column = torch.triu_indices(u.shape[1], u.shape[1])
        parts.append(0.5 * u[:, row] * u[:, column])
    return settings.trend * torch.cat(parts, 1)


class _Kernel(NamedTuple):
    """A kernel and its hyperparameters, see ``free`` of the process."""

    free: Tensor
    num_categories: int
    settings: ProcessSettings

    def amplitude(self) -> Tensor:
        """Return the deviation beside the trend."""
        limit = self.settings.limit
        return self.free[-2].clamp(-limit, limit).exp()

    def __call__(self, u: Tensor, other: Tensor) -> Tensor:
        """Return the covariance without noise of inputs (m, D) and (n, D), (m, n)."""
        free, limit = self.free, self.settings.limit
        c = u.shape[1] - self.num_categories
        length = free[:c].clamp(-limit, limit).exp()
        a, b = u[:, :c] / length, other[:, :c] / length
        square = a.square().sum(1)[:, None] + b.square().sum(1) - 2 * a @ b.T
        square = square.clamp_min(0)
        if self.settings.kind == "smooth":
            correlation = (-0.5 * square).exp()
        else:
            r = (5 * square + 1e-12).sqrt()
            correlation = (1 + r + r.square() / 3) * (-r).exp()
        if self.num_categories:
            differs = (u[:, None, c:] != other[None, :, c:]).double()
            rho = torch.nn.functional.logsigmoid(free[c:-2].clamp(-limit, limit))
            correlation = correlation * (differs @ rho).exp()
        trend = _features(u, self.settings) @ _features(other, self.settings).T
        return trend + self.amplitude().square() * correlation

    def noise(self, noise: str | Tensor, num: int) -> Tensor:
        """Return the variance of each row's noise, shape (n,)."""
        last, limit = self.free[-1], self.settings.limit
        own = self.free.new_zeros(num)
        if isinstance(noise, Tensor):
            own = last.clamp(-2 * limit, limit).sigmoid() * noise.square()
        elif noise == "learned":
            own = own + (2 * last.clamp(-limit, limit)).exp()
        return own + self.settings.jitter


def _hyperparameters(
    u: Tensor,
    y: Tensor,
    noise: str | Tensor,
    num_categories: int,
    settings: ProcessSettings,
) -> tuple[Tensor, float]:
    """Return the most probable logarithms, see ``free``, and the log evidence."""
    num_lengths = u.shape[1] - num_categories
    priors = [settings.length] * num_lengths + [(0.0, 2.0)] * num_categories
    priors += [settings.amplitude, settings.noise]
    if isinstance(noise, Tensor):
        priors[-1] = (0.0, 2.0)  # logit of the factor
    center, deviation = torch.tensor(priors, dtype=torch.float64).T

    def negative_log_evidence(values: Array) -> tuple[float, Array]:
        free = torch.tensor(values, requires_grad=True)
        kernel = _Kernel(free, num_categories, settings)
        covariance = kernel(u, u) + kernel.noise(noise, len(u)).diag()
        white, log_volume = _whitened(covariance, y)
        loss = 0.5 * white.square().sum() + y.shape[1] * log_volume
        loss = loss + 0.5 * ((free - center) / deviation).square().sum()
        return float(loss.detach()), torch.autograd.grad(loss, free)[0].numpy()

    with torch.enable_grad():
        found = minimize(
            negative_log_evidence,
            center.numpy(),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": settings.num_steps},
        )
        if not math.isfinite(found.fun):  # nowhere near: what is most probable before
            return center, -negative_log_evidence(center.numpy())[0]
    return torch.from_numpy(found.x), -float(found.fun)


def _whitened(
    kernel: Tensor, y: Tensor, *, ridges: tuple[float, ...] = (1e-9, 1e-7, 1e-5, 1e-3)
) -> tuple[Tensor, Tensor]:
    """Return whitened outputs, and half the log determinant."""
    factor, failed = torch.linalg.cholesky_ex(kernel)
    for share in ridges:
        if not failed:
            break
        size = float(kernel.detach().diagonal().max())
        ridge = share * size * torch.eye(len(kernel)).to(kernel)
        factor, failed = torch.linalg.cholesky_ex(kernel + ridge)
    white = torch.linalg.solve_triangular(factor, y, upper=False)
    return white, factor.diagonal().log().sum()
