"""Least-squares fits of one model, a dozen simulations each.

A fit follows secants from where it starts, and ends with derivatives at its own best
fit, which whatever is linear rests on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.linear.model import LinearModel, centered, linearize
from sbi_active.criticism.rivals.heavy_tails import deviance_slope, from_deviance
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.least_squares import descend


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Settings of what is spent on fits.

    Attributes:
        num_starts: Draws of the prior at which the bare model's search begins: a mode
            that it missed would be a false alarm.
        num_kept: Searches that go on from there.
        first: Steps of these searches along secants.
        num_drawn: Draws of a further effect at which its fit begins, beside its null.
        num_far: Draws of the prior that are screened for a set with an effect that no
            number makes vanish: parameters beside it lie far from those without it.
        num_kept_far: Draws that are kept.
        secant: Steps along secants between two linearizations.
        rounds: Linearizations at most.
        worth: A fall of the sum of squares that is worth another one, in units of the
            residual's own variance.
        tried: Deviations of its prior by which a further effect is tried.
        faint: Share of them that hardly acts.
        num_bases: Models beside which larger ones are looked for.
        num_pairs: Pairs that are fitted.
        num_larger: Larger sets that are fitted, of each size.
        max_effects: Effects of a set at most.
        behind: Nats by which linear evidence puts a larger set behind one that is
            fitted, so that it is not fitted.
        passes: Tail probability of a chi-square from which nothing larger than a pair
            is looked for.
        alike: Rise of the sum of squares up to which another fit is as good, in units
            of the residual's own variance: a twentieth of the probability, as in an
            alarm.
    """

    num_starts: int = 24
    num_kept: int = 4
    first: int = 8
    num_drawn: int = 3
    num_far: int = 32
    num_kept_far: int = 6
    secant: int = 5
    rounds: int = 4
    worth: float = 0.3
    tried: float = 0.3
    faint: float = 0.03
    num_bases: int = 3
    num_pairs: int = 10
    num_larger: int = 3
    max_effects: int = 4
    behind: float = 10.0
    passes: float = 0.01
    alike: float = 6.0


#: Where the simulator jumps a search ends at any of many places near the best one: with
#: half of the draws one of six sets of the box collision had a wrong name.
JUMPING = FitSettings(num_drawn=12)


def missed_by(rival: Rival, rms: float) -> float:
    """Return the size of errors in a search, in deviations of the sensor.

    Where a model misses, all of its residual counts as an error, so that a search is
    not held by the prior less than it will be. T errors have room for what misses.

    Args:
        rival: The model.
        rms: Root mean square residual of its fit.
    """
    return 1.0 if rival.heavy is not None else max(rms, 1.0)


def best_fits(
    rival: Rival, u: Array, unit: Array, settings: FitSettings
) -> list[LinearModel]:
    """Return models linearized where searches from draws end, the best fit first.

    Half of them begin at the best draws, half at some of the others.

    Args:
        rival: The model.
        u: Draws of its prior, shape (n, d).
        unit: Standard deviation of each number's error, shape (N,).
        settings: Settings of what is spent.
    """
    own = settings
    r = rival.residual(u)[0] / unit
    order = np.argsort((r**2).sum(1))
    half = own.num_starts // 2
    far = order[half :: own.num_starts][: own.num_starts - half]
    u = np.concatenate([u[order[:half]], u[far]])
    scale = missed_by(rival, float(np.sqrt(np.mean(r[order[0]] ** 2))))
    u, cost = along_secants(rival, u, unit * scale, own.first)
    u = u[np.argsort(cost)]
    fits = [polished(rival, p, unit, own) for p in u[: own.num_kept]]
    best, u = min(fits, key=lambda fit: fit.cost), u[own.num_kept :]
    # Whether the end of a search elsewhere is as good shows where it converges.
    apart = u[_compared(rival, best, u, unit)[1]][: own.num_kept]
    fits += [polished(rival, p, unit, own) for p in apart]
    return sorted(fits, key=lambda fit: fit.cost)


def as_good(
    rival: Rival, best: LinearModel, u: Array, unit: Array, settings: FitSettings
) -> Array:
    """Return the fits (k, d) among some (n, d) that are as good as the best, and apart.

    What an exchange or another sign of parameters leaves as it is has several.

    Args:
        rival: The model.
        best: Best fit, linearized in some units.
        u: Other fits, shape (n, d).
        unit: These units, shape (N,).
        settings: Settings of what is as good.
    """
    rise, is_apart = _compared(rival, best, u, unit)
    return u[(rise < settings.alike * missed_by(rival, best.rms) ** 2) & is_apart]


def _compared(
    rival: Rival, best: LinearModel, u: Array, unit: Array, *, times: float = 10.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Return how much more places (n, d) leave than the best fit, and which are apart.

    Those lie in other valleys: the sum of squares rises less than its linear model says
    by ``times``, an order of magnitude, and that more than draws of one posterior do.
    """
    c, places = rival.coordinates, np.concatenate([best.u[None], u])
    prior = ((places - c.center) ** 2 * c.precision).sum(1)
    square = ((rival.residual(places)[0] / unit) ** 2).sum(1) + prior
    linear = (best.at(places) ** 2).sum(1) + prior
    rise, expected = square[1:] - square[0], linear[1:] - linear[0]
    least = best.rms**2 * (len(best.u) + 10)
    return rise, expected > times * np.maximum(rise, least)


def polished(rival: Rival, u: Array, unit: Array, settings: FitSettings) -> LinearModel:
    """Return a model linearized at the best fit from a start near it.

    Args:
        rival: The model.
        u: The start, shape (d,).
        unit: Standard deviation of each number's error, shape (N,).
        settings: Settings of what is spent.
    """
    model = linearize(rival, u, unit)
    for _ in range(settings.rounds - 1):
        if model.promised < settings.worth * missed_by(rival, model.rms) ** 2:
            break
        new = onward(rival, model, unit, settings.secant)
        if (new == model.u).all():
            break
        model = linearize(rival, new, unit)
    return centered(rival, model, unit)


def onward(rival: Rival, model: LinearModel, unit: Array, steps: int) -> Array:
    """Return the place that a search along secants from a linear model ends at, (d,).

    Args:
        rival: Rival with the model's coordinates.
        model: Linear model of it.
        unit: Deviations of residuals in a search, shape (N,) or (2 N,).
        steps: Number of steps at most.
    """
    scale = missed_by(rival, model.rms)
    wide, num = unit * scale, model.num
    r, jacobian = model.residual, model.jacobian
    if rival.heavy is not None:
        r = rival.residual(model.u[None])[0][0] / unit
        slope = deviance_slope(from_deviance(r, rival.heavy[0]), rival.heavy[0])
        jacobian = (slope * model.scale)[:, None] * jacobian
    if rival.reference is not None:  # deviations have the residuals of a search
        r = rival.residual(model.u[None])[0][0]
        slope = jacobian[num:] / np.sqrt(2)
        means = jacobian[:num] - r[:num, None] * slope
        jacobian = np.r_[means, slope / np.maximum(r[num:, None], 1e-3)]
    start = np.clip(model.u, model.low, model.high)[None]
    known = r[None] / scale, jacobian[None] / scale
    return along_secants(rival, start, wide, steps, known)[0][0]


def refitted(
    rival: Rival,
    model: LinearModel,
    unit: Array,
    kept: Array,
    near: Iterable[Array] = (),
) -> Array:
    """Return the best fit of a model to some of the numbers, shape (d,).

    Along a valley that the other numbers held closed it takes some ten steps.

    Args:
        rival: The model.
        model: The model linearized at its best fit to all.
        unit: Deviations of residuals in a search, shape (N,) or (2 N,).
        kept: Mask of the numbers, shape (N,).
        near: Places to begin at as well, each of shape (d,).
    """
    wide, kept = unit * missed_by(rival, model.rms), np.resize(kept, len(unit))

    def whiten(residual: Array) -> Array:
        return np.where(kept, residual / wide, 0.0)

    start = np.clip([model.u, *near], model.low, model.high)
    u, cost = descend(rival, start, whiten, rival.step, 30)
    return u[cost.argmin()]


def along_secants(
    rival: Rival,
    u: Array,
    unit: Array,
    steps: int,
    known: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return starts (n, d) improved along secants, and their cost.

    Args:
        rival: The model.
        u: Starts, shape (n, d).
        unit: Units of residuals, shape (N,).
        steps: Number of steps at most.
        known: Residuals in units and derivatives at the starts, (n, N) and (n, N, d).
    """
    return descend(
        *(rival, u, lambda r: r / unit, rival.step, steps), secant=True, known=known
    )
