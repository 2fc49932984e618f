"""A rival linearized at its best fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.least_squares import within

Array = NDArray[Any]

#: Share of the squares that is added to them, so that a flat direction is solved for.
RIDGE = 1e-9
#: Precision of the Gaussian that stands for a prior between two bounds: wide enough
#: to leave parameters alone that the trials determine.
FLAT = 0.3


@dataclass(frozen=True)
class LinearModel:
    r"""A rival near its best fit, :math:`r(u) = r(\hat u) + J (u - \hat u)`.

    Attributes:
        key: Key of the rival.
        u: Point at which it is linearized, shape (d,).
        residual: Residual there, in standard deviations of the sensor, shape (N,).
        jacobian: Derivatives of the residual, shape (N, d).
        center: Center of the prior, shape (d,).
        sd: Standard deviation of the prior, shape (d,).
        scaled: Coordinates of effects whose prior has an unknown scale, bool, (d,).
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
        own: Coordinates of theta and phi; those of the trials' nuisances follow.
        trial_of: The trial that each coordinate belongs to, -1 for all, shape (d,).
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
    own: int
    trial_of: NDArray[np.int64]

    @property
    def rows(self) -> Array:
        """Residual at the best fit and minus its derivatives, shape (N, 1 + d).

        Far from the fit residuals may be thousands of sensor deviations, and of their
        squares nothing would be left of what the sensor tells.
        """
        return np.concatenate([self.residual[:, None], -self.jacobian], 1)

    @property
    def rms(self) -> float:
        """Root mean square of the residual, in standard deviations of the sensor."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def chi_square(self) -> tuple[float, int, float]:
        """Against the sensor's error: its value, degrees of freedom and tail."""
        square = float((self.residual**2).sum())
        freedom = max(len(self.residual) - len(self.u), 1)
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
        normal = normal + np.diag(RIDGE * (1 + np.diag(normal)))
        off = (self.u - self.center) * weight
        gradient = self.jacobian.T @ self.residual / scale + off
        at = self.u[None]
        step = within(normal[None], gradient[None], at, self.low, self.high)
        move = np.clip(self.u - step[0], self.low, self.high) - self.u

        def cost(r: Array, u: Array) -> float:
            prior = (weight * (u - self.center) ** 2).sum()
            return float((r**2).sum() / scale + prior)

        after = cost(self.residual + self.jacobian @ move, self.u + move)
        return (cost(self.residual, self.u) - after) * scale

    def widened(self, width: float) -> Array:
        """Return the prior's deviations with effects on another scale, shape (d,)."""
        return np.where(self.scaled, width * self.sd, self.sd)


def linearize(rival: Rival, u: Array, unit: Array) -> LinearModel:
    """Return a rival linearized at one point, by steps to one side.

    Args:
        rival: Rival with effects that change the prediction.
        u: Point of linearization, shape (d,).
        unit: Standard deviation of the sensor, shape (N,).
    """
    r, jacobian = rival.jacobian(u[None], lambda residual: residual / unit, rival.step)
    return with_prior(rival, u, r[0], jacobian[0])


def centered(rival: Rival, model: LinearModel, unit: Array) -> LinearModel:
    """Return a linearized rival with derivatives from both sides.

    From one side the curvature of a response is taken for a slope: of two parameters
    that only their product tells, it would tell each.

    Args:
        rival: Rival that is linearized.
        model: Rival linearized by steps to one side.
        unit: Standard deviation of the sensor, shape (N,).
    """
    at, step = model.u[None], -rival.step
    _, jacobian = rival.jacobian(at, lambda residual: residual / unit, step)
    return replace(model, jacobian=(model.jacobian + jacobian[0]) / 2)


def with_prior(rival: Rival, u: Array, residual: Array, jacobian: Array) -> LinearModel:
    """Return a linearized rival with the Gaussian that stands for its prior."""
    c = rival.coordinates
    bounded = np.isfinite(c.low) & np.isfinite(c.high)
    scaled = np.zeros(rival.dim, dtype=bool)
    precision = np.where(c.precision > 0, c.precision, FLAT)
    names = {e.name for e in rival.effects}
    for name, place in rival.columns().items():
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
        own=sum(c.joint.sizes),
        trial_of=c.trial_of(),
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
    return with_prior(rival, u, model.residual, jacobian)


def chords(
    rival: Rival,
    u: Array,
    new: NDArray[np.bool_],
    tried: Array | float,
    residual: Array,
    unit: Array,
) -> Array:
    """Return derivatives of the residual by some coordinates, shape (N, k).

    They are difference quotients over a step within the bounds and no tangents: many
    effects are flat at their null.

    Args:
        rival: The model.
        u: Point to start from, shape (d,).
        new: Mask of the new coordinates, bool, shape (d,).
        tried: Length of the step, one or one each, shape (k,).
        residual: Residual at u, in units, shape (N,).
        unit: Standard deviation of each number's error, shape (N,).
    """
    where = np.flatnonzero(new)
    beyond = u[where] + np.abs(tried) > rival.coordinates.high[where]
    step = np.where(beyond, -np.abs(tried), np.abs(tried))
    points = np.repeat(u[None], len(where), 0)
    points[np.arange(len(where)), where] += step
    if not len(where):
        return np.empty((len(residual), 0))
    r = rival.residual(points)[0] / unit
    return ((r - residual) / step[:, None]).T


def at_null(rival: Rival, effect: Effect, tried: float) -> tuple[Array, Array]:
    """Return the null of an effect among the coordinates, and a step from it, (k,).

    Args:
        rival: Rival with this effect.
        effect: The effect.
        tried: Length of the step.
    """
    c, place = rival.coordinates, rival.columns()[effect.name]
    z = c.to_z(np.clip(np.zeros((1, rival.dim)), c.low, c.high))
    # Where no number makes it vanish, the end of the prior that is nearest to it.
    z[:, place] = effect.null_phi(1, finite=True).double().numpy()
    with np.errstate(divide="ignore"):
        u = np.clip(c.from_z(z)[0], c.low, c.high)[place]
    return u, np.where(u + tried > c.high[place], -tried, tried)


def has_null(effect: Effect) -> bool:
    """Return whether some number makes an effect vanish."""
    return bool(effect.null_phi(1).isfinite().all())
