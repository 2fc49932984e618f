r"""Gaussian processes on few simulations, of outcomes with or without noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]
Kind = Literal["smooth", "rough"]

NUM_STEPS = 25  # of the optimizer of the hyperparameters
#: Mean and deviation of the logarithms a priori, for inputs and outputs of unit size.
LENGTH_PRIOR = (math.log(2.5), 1.0)
AMPLITUDE_PRIOR = (math.log(0.5), 1.5)
NOISE_PRIOR = (math.log(0.3), 1.5)
TREND = 3.0  # deviation of the trend's coefficients, outputs of unit size
JITTER = 1e-7  # of the variance: a noise below 3e-4 of it is not resolved
ROUNDED = 1e-7  # of the largest output, which single precision does not tell
SPARE = 3  # rows beyond the features before a trend is taken off
ROWS_A_FEATURE = 2.0  # that a quadratic trend takes at least
LIMIT = 6.0  # of the logarithms, beyond which a line search may not step
MOST_FITTED = 250  # rows that hyperparameters are fitted to
INFLATION = 16.0  # of the variance at most, where left-out rows are missed by more


@dataclass(frozen=True)
class GaussianProcess:
    r"""Regression of outputs y (n, q) on inputs u (n, D), outputs sharing a kernel.

    .. math::
        k(u, u') = b^2 h(u)^\top h(u') + \sigma^2 \kappa(r) + \tau^2 [u = u'], \qquad
        r^2 = \sum_i (u_i - u'_i)^2 / \ell_i^2,

    with h a linear or quadratic basis, :math:`\kappa` a squared exponential ("smooth")
    or Matern 5/2 ("rough"), and the hyperparameters at their most probable values. The
    variance is scaled so that left-out rows are missed by as much as it says.
    Of outputs without noise a least-squares trend is taken off first: they may differ
    by 10,000 deviations of the noise declared beside them, and are to be known to one.

    Attributes:
        u: Inputs, shape (n, D).
        kind: Of the kernel.
        degree: Of the trend.
        log_length: Logarithms of the lengths, shape (D,).
        log_amplitude: Of :math:`\sigma`.
        noise_variance: :math:`\tau^2`, of outputs of unit size.
        weight: :math:`K^{-1} y`, shape (n, q).
        precision: :math:`K^{-1}`, shape (n, n).
        shift: Of the outputs, shape (q,).
        taken_off: Coefficients of a trend that the process is beside, shape (p, q).
        scale: Of the outputs, shape (q,).
        inflation: Of the variance, shape (q,).
        left_out: Residuals of left-out rows, shape (n, q), in units of y.
        log_evidence: Of the data and the hyperparameters.

    References:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, sections
        2.7 and 5.4.2.
    """

    u: Array
    kind: Kind
    degree: int
    log_length: Array
    log_amplitude: float
    noise_variance: float
    weight: Array
    precision: Array
    shift: Array
    taken_off: Array
    scale: Array
    inflation: Array
    left_out: Array
    log_evidence: float

    @property
    def noise_sd(self) -> Array:
        r""":math:`\tau` in units of y, shape (q,)."""
        return self.scale * np.sqrt(self.noise_variance * self.inflation)

    @staticmethod
    def fit(
        u: Array,
        y: Array,
        *,
        noisy: bool,
        kind: Kind = "smooth",
        degree: Literal[1, 2] | None = None,
    ) -> Any:
        """Return the process of inputs (n, D) and outputs (n, q), n >= 2.

        Args:
            u: Of about unit size.
            y: Outputs.
            noisy: Whether y has noise, whose variance is then learned.
            kind: Of the kernel.
            degree: Of the trend; None takes a quadratic one where rows are twice its
                features, which of many inputs and much noise is too many.
        """
        shift, scale = y.mean(0), y.std(0)
        size = np.abs(y).max(0)
        scale = np.where(scale > 1e-6 * size, scale, np.maximum(size, 1e-30))
        if degree is None:
            enough = len(u) >= ROWS_A_FEATURE * num_features(u.shape[1])
            degree = 2 if enough else 1
        basis = _features(torch.from_numpy(u), degree).numpy()
        taken_off, rest = np.zeros((basis.shape[1], y.shape[1])), y - shift
        spare = len(u) - basis.shape[1]
        if not noisy and spare >= SPARE:
            taken_off = np.linalg.lstsq(basis, rest, rcond=None)[0]
            rest = rest - basis @ taken_off
            spread = np.sqrt((rest**2).sum(0) / spare)
            scale = np.maximum(spread, np.maximum(ROUNDED * size, 1e-30))
        values = rest / scale
        every = max(1, -(-len(u) // MOST_FITTED))
        free, evidence = _hyperparameters(
            u[::every], values[::every], degree, noisy=noisy, kind=kind
        )
        noise = float(np.exp(2 * free[-1])) if noisy else 0.0
        cover = _kernel(torch.from_numpy(u), torch.from_numpy(u), free, degree, kind)
        kernel = cover.numpy() + (noise + JITTER) * np.eye(len(u))
        precision = np.linalg.inv(kernel)
        precision = 0.5 * (precision + precision.T)
        weight = precision @ values
        variance = 1 / np.diag(precision)
        left_out = weight * variance[:, None]
        missed = (left_out**2 / variance[:, None]).mean(0)
        return GaussianProcess(
            u=u,
            kind=kind,
            degree=degree,
            log_length=free[:-2].numpy(),
            log_amplitude=float(free[-2]),
            noise_variance=noise + JITTER,
            weight=weight,
            precision=precision,
            shift=shift,
            taken_off=taken_off,
            scale=scale,
            inflation=np.clip(missed, 1.0, INFLATION),
            left_out=left_out * scale,
            log_evidence=evidence,
        )

    def predict(self, u: Array) -> tuple[Array, Array]:
        """Return mean and variance without noise at inputs (m, D), both (m, q)."""
        cross, trend = self._beside(u)
        own = (trend**2).sum(1) + np.exp(2 * self.log_amplitude)
        variance = own - ((cross @ self.precision) * cross).sum(1)
        variance = np.maximum(variance, JITTER)[:, None] * self.inflation
        mean = self.shift + trend @ self.taken_off + (cross @ self.weight) * self.scale
        return mean, variance * self.scale**2

    def mean(self, u: Array) -> Array:
        """Return the mean alone, which costs less, (m, D) -> (m, q)."""
        cross, trend = self._beside(u)
        return self.shift + trend @ self.taken_off + (cross @ self.weight) * self.scale

    def _beside(self, u: Array) -> tuple[Array, Array]:
        """Return the kernel with the rows (m, n), and the trend's features (m, p)."""
        last = [self.log_amplitude, 0.0]
        free = torch.from_numpy(np.concatenate([self.log_length, last]))
        cross = _kernel(
            torch.from_numpy(u), torch.from_numpy(self.u), free, self.degree, self.kind
        ).numpy()
        return cross, _features(torch.from_numpy(u), self.degree).numpy()


def num_features(dim: int) -> int:
    """Return the features of a quadratic trend of so many inputs."""
    return 1 + dim + dim * (dim + 1) // 2


def _features(u: Tensor, degree: int) -> Tensor:
    """Return the trend's features times their deviations, shape (n, p)."""
    parts = [torch.ones(len(u), 1).to(u), u]
    if degree == 2:
        row, column = torch.triu_indices(u.shape[1], u.shape[1])
        parts.append(0.5 * u[:, row] * u[:, column])
    return TREND * torch.cat(parts, 1)


def _kernel(u: Tensor, other: Tensor, free: Tensor, degree: int, kind: Kind) -> Tensor:
    length = free[:-2].clamp(-LIMIT, LIMIT).exp()
    a, b = u / length, other / length
    square = (a.square().sum(1)[:, None] + b.square().sum(1) - 2 * a @ b.T).clamp_min(0)
    if kind == "smooth":
        correlation = (-0.5 * square).exp()
    else:
        r = (5 * square + 1e-12).sqrt()
        correlation = (1 + r + r.square() / 3) * (-r).exp()
    trend = _features(u, degree) @ _features(other, degree).T
    return trend + (2 * free[-2].clamp(-LIMIT, LIMIT)).exp() * correlation


def _hyperparameters(
    u: Array, y: Array, degree: int, *, noisy: bool, kind: Kind
) -> tuple[Tensor, float]:
    """Return logarithms of lengths, amplitude and noise, and the log evidence."""
    inputs, values = torch.from_numpy(u), torch.from_numpy(y)
    start = [LENGTH_PRIOR[0]] * u.shape[1] + [AMPLITUDE_PRIOR[0], NOISE_PRIOR[0]]
    free = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    eye = torch.eye(len(u), dtype=torch.float64)
    optimizer = torch.optim.LBFGS(
        [free], max_iter=NUM_STEPS, line_search_fn="strong_wolfe"
    )

    def negative_log_evidence() -> Tensor:
        bound = free.clamp(-LIMIT, LIMIT)
        correlated = _kernel(inputs, inputs, bound, degree, kind)
        noise = (2 * bound[-1]).exp() if noisy else 0.0
        kernel = correlated + (noise + JITTER) * eye
        factor, failed = torch.linalg.cholesky_ex(kernel)
        for share in (1e-9, 1e-7, 1e-5, 1e-3):
            if not failed:
                break
            size = float(kernel.detach().diagonal().max())
            factor, failed = torch.linalg.cholesky_ex(kernel + share * size * eye)
        white = torch.linalg.solve_triangular(factor, values, upper=False)
        loss = 0.5 * white.square().sum()
        loss = loss + values.shape[1] * factor.diagonal().log().sum()
        length = (free[:-2] - LENGTH_PRIOR[0]) / LENGTH_PRIOR[1]
        amplitude = (free[-2] - AMPLITUDE_PRIOR[0]) / AMPLITUDE_PRIOR[1]
        deviation = (free[-1] - NOISE_PRIOR[0]) / NOISE_PRIOR[1]
        return loss + 0.5 * (length.square().sum() + amplitude**2 + deviation**2)

    def closure() -> Tensor:
        with torch.enable_grad():
            optimizer.zero_grad()
            loss = negative_log_evidence()
            loss.backward()
            return loss

    optimizer.step(closure)  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        found = free.detach().clamp(-LIMIT, LIMIT)
        if not bool(found.isfinite().all()):
            found = torch.tensor(start, dtype=torch.float64)
        free.data.copy_(found)
        return found, -float(negative_log_evidence())
