"""A rival linearized at its best fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import LOG_2PI
from sbi_active.criticism.rivals.heavy_tails import from_deviance, tangent
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.least_squares import within
from sbi_active.inference.sampling.mixtures import eigh

#: What a linear model has one of for each coordinate.
COORDINATES = ("u", "center", "sd", "scaled", "low", "high", "trial_of")
#: Share of the squares that is added to them, so that a flat direction is solved for.
RIDGE = 1e-9


@dataclass(frozen=True)
class LinearModel:
    r"""A rival near its best fit, :math:`r(u) = r(\hat u) + J (u - \hat u)`.

    Attributes:
        key: Key of the rival.
        u: Point at which it is linearized, shape (d,).
        residual: Residual there, in standard deviations of the sensor, shape (N,); of
            a random simulator twice as long, with one for each deviation.
        jacobian: Derivatives of the residual, shape (N, d) or (2 N, d).
        center: Center of the prior, shape (d,).
        sd: Standard deviation of the prior, shape (d,).
        scaled: Coordinates of effects whose prior has an unknown scale, bool, (d,).
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
        trial_of: The trial that each coordinate belongs to, -1 for all, shape (d,).
        num: Number of measured numbers, N.
        scale: Unit of each residual in deviations of the sensor, shape (N,); one unless
            errors have heavy tails, or the simulator is random or gives no number.
        offset: Log densities of the numbers at the best fit less those of Gaussian
            residuals, shape (N,); zero for Gaussian errors that are declared.
        weight: Deviation of the error by that of the Gaussian which stands for it, of
            each number, shape (N,), or one; small where a t error is far out.
        peak: Log density of this Gaussian at its peak, in deviations of the error.
    """

    key: ModelKey
    u: Array
    residual: Array
    jacobian: Array
    center: Array
    sd: Array
    scaled: NDArray[np.bool_]
    low: Array
    high: Array
    trial_of: NDArray[np.int64]
    num: int
    scale: Array
    offset: Array
    weight: Array | float = 1.0
    peak: Array | float = -0.5 * LOG_2PI

    @property
    def cost(self) -> float:
        """Twice the negative log likelihood at the best fit, but for a constant."""
        return float((self.residual**2).sum() - 2 * self.offset.sum())

    @property
    def rows(self) -> Array:
        """Residual at the best fit and minus its derivatives, shape (N, 1 + d).

        Far from the fit residuals may be thousands of sensor deviations, and of their
        squares nothing would be left of what the sensor tells.
        """
        return np.concatenate([self.residual[:, None], -self.jacobian], 1)

    @property
    def errors(self) -> Array:
        """Residuals in deviations of the error, however far out, shape (N,)."""
        return self.residual[: self.num] / self.weight

    @property
    def rms(self) -> float:
        """Root mean square of the residual, in standard deviations of the sensor."""
        return float(np.sqrt(np.mean(self.residual[: self.num] ** 2)))

    @property
    def chi_square(self) -> tuple[float, int, float]:
        """Against the sensor's error: its value, degrees of freedom and tail."""
        square = float((self.residual[: self.num] ** 2).sum())
        freedom = max(self.num - len(self.u), 1)
        return square, freedom, float(chi2.sf(square, freedom))

    @property
    def promised(self) -> float:
        """Fall of the sum of squares at its linear optimum.

        It is in sensor variances, with the residual's own size as that of the errors.
        """
        scale = max(self.rms, 1.0) ** 2
        bounded = np.isfinite(self.low) & np.isfinite(self.high)
        weight = np.where(bounded, 0.0, 1.0) / self.sd**2
        normal = self.jacobian.T @ self.jacobian / scale + np.diag(weight)
        off = (self.u - self.center) * weight
        gradient = self.jacobian.T @ self.residual / scale + off
        system = normal + np.diag(RIDGE * (1 + np.diag(normal)))
        at = self.u[None]
        step = within(system[None], gradient[None], at, self.low, self.high)
        move = np.clip(self.u - step[0], self.low, self.high) - self.u
        return float(-(2 * gradient + normal @ move) @ move) * scale

    def part(self, at: NDArray[Any]) -> LinearModel:
        """Return the model of some of its coordinates, the others held where it is."""
        own = {name: getattr(self, name)[at] for name in COORDINATES}
        return replace(self, jacobian=self.jacobian[:, at], **own)

    def joined(self, others: Sequence[LinearModel]) -> LinearModel:
        """Return the model with the coordinates of others after its own."""
        every = [self, *others]
        own = {n: np.concatenate([getattr(m, n) for m in every]) for n in COORDINATES}
        jacobian = np.concatenate([model.jacobian for model in every], 1)
        return replace(self, jacobian=jacobian, **own)

    def from_here(self) -> LinearModel:
        """Return the model with coordinates that count from where it is."""
        shifted = {n: getattr(self, n) - self.u for n in ("u", "center", "low", "high")}
        return replace(self, **shifted)

    def at(self, u: Array) -> Array:
        """Return the residuals at other places, (n, N) or (n, 2 N), of u (n, d)."""
        return self.residual + (u - self.u) @ self.jacobian.T

    def draws(
        self, mean: Array, cov: Array, num: int, rng: np.random.Generator
    ) -> Array:
        """Return normal draws of the coordinates, moved into the bounds, (num, d)."""
        values, vectors = eigh(cov)
        root = vectors * np.sqrt(np.clip(values, 0, None))
        u = mean + rng.normal(size=(num, len(root))) @ root.T
        return np.clip(u, self.low, self.high)

    def widened(self, width: float) -> Array:
        """Return the prior's deviations with effects on another scale, shape (d,)."""
        return np.where(self.scaled, width * self.sd, self.sd)


def linearize(
    rival: Rival, u: Array, unit: Array, step: float | None = None
) -> LinearModel:
    """Return a rival linearized at one point, by steps to one side.

    Args:
        rival: Rival with effects that change the prediction.
        u: Point of linearization, shape (d,).
        unit: Standard deviation of the sensor, shape (N,).
        step: Step of finite differences; None takes the rival's.
    """
    step = rival.step if step is None else step
    r, jacobian = rival.jacobian(u[None], partial(_errors_of, rival, unit=unit), step)
    model = with_prior(rival, u, r[0], jacobian[0])
    if rival.simulator.failed or rival.reference is not None:
        model = _in_own_deviations(rival, model, unit)
    if rival.heavy is None:
        return model
    return touching(model, model.residual, rival.heavy[0])


def _errors_of(rival: Rival, residual: Array, unit: Array) -> Array:
    """Return the errors, in deviations of the sensor, of the residuals of a search."""
    residual = residual / unit
    return residual if rival.heavy is None else from_deviance(residual, rival.heavy[0])


def _in_own_deviations(rival: Rival, model: LinearModel, unit: Array) -> LinearModel:
    r"""Return a linearized rival with deviations that are the simulator's.

    A number that the simulator does not give has that of the prior predictive. The
    deviations :math:`s_i` of a random simulator have residuals of their own, by
    Fisher's scores of the Gaussian likelihood,

    .. math::
        \frac{1 - r_i^2}{\sqrt2}, \qquad \sqrt2\, \frac{\partial \log s_i}{\partial u},

    so that both together have its gradient and its expected curvature; what its value
    at the fit is besides stands in ``offset``.

    Args:
        rival: Rival that is linearized.
        model: Linear model with the residuals of a search.
        unit: Standard deviation of the sensor, shape (N,).
    """
    num = model.num
    residual, log_scale, _ = rival.residual(model.u[None], penalized=False)
    residual, log_scale = residual[0] / unit, np.resize(log_scale[0], num)
    jacobian, offset = model.jacobian, np.zeros(num)
    if rival.reference is not None:
        log_scale = log_scale - np.log(rival.reference)
        slope, own = jacobian[num:] * residual[num:, None], residual[:num]
        # Beyond a square of four a residual is no typical one, and its score no slope
        # of a Gaussian: with half a score is biased where the model is right, with
        # twice a few numbers far out move all deviations.
        score = (1 - np.minimum(own**2, 4.0)) / np.sqrt(2)
        offset = 0.5 * score**2
        residual = np.append(own, score)
        means = jacobian[:num] + own[:, None] * slope
        jacobian = np.concatenate([means, np.sqrt(2) * slope])
    return replace(
        model,
        residual=residual,
        jacobian=jacobian,
        scale=np.exp(log_scale),
        offset=offset - log_scale,
    )


def touching(model: LinearModel, error: Array, df: float) -> LinearModel:
    """Return a linear model of t errors as Gaussians that touch their density.

    Args:
        model: Linear model, of Gaussians that touch it elsewhere or of none yet.
        error: Errors at which they touch it, in deviations of the error, shape (N,).
        df: Degrees of freedom.
    """
    weight, peak = tangent(error, df)
    change = weight / model.weight
    return replace(
        model,
        residual=change * model.residual,
        jacobian=change[:, None] * model.jacobian,
        scale=model.scale / change,
        offset=model.offset - model.peak + peak,
        weight=weight,
        peak=peak,
    )


def centered(rival: Rival, model: LinearModel, unit: Array) -> LinearModel:
    """Return a linearized rival with derivatives from both sides.

    From one side the curvature of a response is taken for a slope: of two parameters
    that only their product tells, it would tell each.

    Args:
        rival: Rival that is linearized.
        model: Rival linearized by steps to one side.
        unit: Standard deviation of the sensor, shape (N,).
    """
    other = linearize(rival, model.u, unit, step=-rival.step)
    return replace(model, jacobian=(model.jacobian + other.jacobian) / 2)


def with_prior(rival: Rival, u: Array, residual: Array, jacobian: Array) -> LinearModel:
    """Return a linearized rival with the Gaussian that stands for its prior.

    Between two bounds it is wide enough to leave parameters alone that the trials
    determine.
    """
    c = rival.coordinates
    bounded = np.isfinite(c.low) & np.isfinite(c.high)
    scaled = np.zeros(rival.dim, dtype=bool)
    precision = np.where(c.precision > 0, c.precision, 0.3)
    names = {e.name for e in rival.effects}
    for name, place in c.places.items():
        if name in names:
            scaled[place] = ~bounded[place]
            # Between bounds a phi is as likely anywhere: its own variance is one.
            precision[place] = np.where(bounded[place], 1.0, precision[place])
    return LinearModel(
        key=rival.key,
        u=u,
        residual=residual,
        jacobian=jacobian,
        center=c.center,
        sd=1 / np.sqrt(precision),
        scaled=scaled,
        low=c.low,
        high=c.high,
        trial_of=c.trial_of(),
        num=rival.num_observed,
        scale=np.ones(rival.num_observed),
        offset=np.zeros(rival.num_observed),
    )


def enlarged(
    model: LinearModel,
    rival: Rival,
    new: NDArray[np.bool_],
    values: Array,
    columns: Array,
) -> LinearModel:
    """Return a model with further coordinates.

    Args:
        model: Linear model without them.
        rival: Rival with them.
        new: Mask of these among the rival's coordinates, bool, shape (d,).
        values: Values of the new ones, shape (k,).
        columns: Derivatives of the residual by them, shape (N, k).
    """
    u, jacobian = np.empty(rival.dim), np.empty((len(model.residual), rival.dim))
    u[~new], jacobian[:, ~new] = model.u, model.jacobian
    u[new], jacobian[:, new] = values, columns
    larger = with_prior(rival, u, model.residual, jacobian)
    names = "scale", "offset", "weight", "peak"
    return replace(larger, **{name: getattr(model, name) for name in names})


def chords(
    rival: Rival,
    u: Array,
    new: NDArray[np.bool_],
    tried: Array | float,
    model: LinearModel,
    unit: Array,
) -> Array:
    """Return derivatives of a model's residual by further coordinates, shape (N, k).

    They are difference quotients over a step within the bounds and no tangents: many
    effects are flat at their null.

    Args:
        rival: The model.
        u: Point to start from, shape (d,).
        new: Mask of the new coordinates, bool, shape (d,).
        tried: Length of the step, one or one each, shape (k,).
        model: Model without them, fitted at u.
        unit: Standard deviation of each number's error, shape (N,).
    """
    where = np.flatnonzero(new)
    beyond = u[where] + np.abs(tried) > rival.coordinates.high[where]
    step = np.where(beyond, -np.abs(tried), np.abs(tried))
    points = np.repeat(u[None], len(where), 0)
    points[np.arange(len(where)), where] += step
    if not len(where):
        return np.empty((len(model.residual), 0))
    r, before = _errors_of(rival, rival.residual(points)[0], unit), model.residual
    num = model.num
    if rival.reference is not None:
        # Half of a square is a log; deviations stay those of the fit.
        own = rival.residual(u[None])[0][0]
        change = 0.5 * (r[:, num:] ** 2 - own[num:] ** 2)
        r = np.concatenate([r[:, :num] * np.exp(change), np.sqrt(2) * change], 1)
        before = np.append(before[:num], np.zeros(num))
    if rival.heavy is not None:
        r /= model.scale
    return ((r - before) / step[:, None]).T


def at_null(rival: Rival, effect: Effect, tried: float) -> tuple[Array, Array]:
    """Return the null of an effect among the coordinates, and a step from it, (k,).

    Args:
        rival: Rival with this effect.
        effect: The effect.
        tried: Length of the step.
    """
    c = rival.coordinates
    place = c.places[effect.name]
    z = c.to_z(np.clip(np.zeros((1, rival.dim)), c.low, c.high))
    # Where no number makes it vanish, the end of the prior that is nearest to it.
    z[:, place] = effect.null_phi(1, finite=True).double().numpy()
    with np.errstate(divide="ignore"):
        u = np.clip(c.from_z(z)[0], c.low, c.high)[place]
    return u, np.where(u + tried > c.high[place], -tried, tried)


def has_null(effect: Effect) -> bool:
    """Return whether some number makes an effect vanish."""
    return bool(effect.null_phi(1).isfinite().all())
