"""How far draws of a linear model are off.

They are where the simulator bends, and there drawn by ``infer``, where trials disagree,
and beside bounds of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm, rankdata

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import shared_errors
from sbi_active.criticism.identification.fitting import Fitted
from sbi_active.criticism.linear.processes import parts_of
from sbi_active.criticism.rivals.fit import NESTED
from sbi_active.inference.engine import Fit, infer, search
from sbi_active.inference.engine.settings import Settings


@dataclass(frozen=True)
class SettledError:
    """The likeliest error of each channel, as a rival has it.

    Attributes:
        linear: Linear model whose errors they are.
    """

    linear: Fitted
    is_known = True

    @property
    def noise(self) -> SettledError:
        """The error, of which nothing is unknown."""
        return self

    @property
    def typical_sd(self) -> Array:
        """Unit of each number, shape (N,)."""
        return self.linear.unit

    def start(self, residual: Array) -> Array:
        """Return whitened residuals, (..., N) -> (..., N)."""
        rows = (residual / self.linear.unit).reshape(-1, residual.shape[-1])
        trial = self.linear.measurements.trial
        return self.linear.whitened(rows.T, 0 * trial).T.reshape(residual.shape)

    def log_likelihood(self, residual: Array) -> Array:
        """Return log likelihoods but for a constant, (..., N) -> (...)."""
        return -0.5 * (self.start(residual) ** 2).sum(-1)


def bends(linear: Fitted, at: NDArray[np.int64], most: float) -> bool:
    """Return whether the simulator's density is another one than the linear model's.

    Args:
        linear: Linear model with draws.
        at: Places of the draws that are looked at, shape (k,).
        most: Deviation of the log density ratio up to which it is not, nats.
    """
    error, model, c = SettledError(linear), linear.model, linear.rival.coordinates
    u = linear.draws.u[at]
    left = linear.rival.residual(linear.origin + u)[0], linear.unit * model.at(u)
    log_p, log_q = error.log_likelihood(np.stack(left))
    # At a bound, where absent effects stand, rounding would be outside.
    log_p = log_p + c.log_prob(np.clip(linear.origin + u, c.low, c.high))
    log_q = log_q - 0.5 * (((u - model.center) / model.sd) ** 2).sum(1)
    return not (log_p - log_q).std() < most  # NaN: not simulated


def sampled(
    linear: Fitted, present: NDArray[np.bool_], rng: np.random.Generator, most: int
) -> Fit:
    """Return the posterior given the likeliest errors and some effects.

    Args:
        linear: Linear model with draws.
        present: Whether each effect is there, shape (e,).
        rng: Source of the draws.
        most: Simulations of all trials to spend.
    """
    free, error = linear.free(present.nonzero()[0]), SettledError(linear)
    rival = replace(linear.only(present), error=cast(Any, error))
    u, c = linear.origin + linear.draws.u.mean(0), linear.rival.coordinates
    near = np.tile(u, (1 + len(linear.others), 1))
    near[1:, linear.free(())] = linear.others
    near = np.clip(near, c.low, c.high)[:, free]
    found = search(rival, rng, near, NESTED)
    settings = Settings(num_simulations=most * rival.num_trials)
    return infer(rival, rng, found=found, settings=settings)


class Spread(NamedTuple):
    """The disagreement between parts of the trials.

    Attributes:
        p_value: p-value of each parameter being the same in all parts, shape (d,).
        deviation: Deviation of the parts from their mean, as far as it is none of their
            errors, shape (f, d), such that normal multiples of them add up to the
            spread.
        sd: Standard deviation of each parameter by all trials if it had no bounds,
            shape (d,).
    """

    p_value: Array
    deviation: Array
    sd: Array


def spread(found: Fitted, fewest: int) -> Spread:
    """Return the disagreement of parts of the trials about theta.

    Args:
        found: The model, linear.
        fewest: Number of parts at least.
    """
    draws, m, own = found.draws, found.measurements, found.rival.theta_dim
    likely = (draws.present.mean(0) > 0.5).nonzero()[0]
    free = (found.model.trial_of < 0) & found.free(likely)
    parts = parts_of(m, fewest, fewest)
    white = found.whitened(found.model.rows[:, np.append(True, free)], parts)
    each = [white[parts == f] for f in range(int(parts.max()) + 1)]
    grams = np.stack([rows.T @ rows for rows in each])
    precision, linear = grams[:, 1:, 1:], grams[:, 1:, 0]
    total = precision.sum(0)
    ridge = np.diag(1e-6 * np.diag(total) + 1e-12)
    best = np.linalg.solve(total + ridge, linear.sum(0))
    cov = np.linalg.inv(precision + ridge)
    each = best + np.einsum("fij,fj->fi", cov, linear - precision @ best)
    each, sd = each[:, :own], np.sqrt(np.einsum("fii->fi", cov))[:, :own]
    weight = 1 / sd**2
    mean = (weight * each).sum(0) / weight.sum(0)
    square, freedom = (weight * (each - mean) ** 2).sum(0), len(each) - 1
    of_parts = weight.sum(0) - (weight**2).sum(0) / weight.sum(0)
    variance = np.maximum(square - freedom, 0.0) / np.maximum(of_parts, 1e-300)
    # Deviations that are far off by their errors count less.
    off = np.sqrt(weight) * (each - mean)
    off = off / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    p_value = chi2.sf(square, max(freedom, 1))
    whole = np.sqrt(np.diag(np.linalg.inv(total + ridge)))[:own]
    return Spread(p_value, off * np.sqrt(variance), whole)


def shared(found: Fitted) -> tuple[float, float]:
    """Return how much larger variances are by errors that trials share, and a p-value.

    The posterior takes errors of different trials for independent; the variance of what
    a parameter is off by grows as that of their sums over trials.
    """
    m, at = found.measurements, found.model.at(found.draws.u.mean(0)[None])[0]
    white = found.whitened(at[:, None], 0 * m.trial)[:, 0]
    return shared_errors(white, np.stack([m.channel, m.time]))


def reflected(u: Array, low: Array, high: Array) -> Array:
    """Return draws that left the bounds as far inside of them."""
    u = np.where(u < low, 2 * low - u, u)
    u = np.where(u > high, 2 * high - u, u)
    return np.clip(u, low, high)


def opened(inside: Array, sd: float, half: float) -> Array:
    """Return distances of draws from a bound, as half a Gaussian at least, (n,).

    Where trials ask for what is far beyond it, the posterior within has no width, which
    says nothing of the parameter.

    Args:
        inside: Distances from the bound, shape (n,).
        sd: Deviation that the parameter has without bounds.
        half: Share of it that is wide enough.
    """
    if inside.std() >= half * sd:
        return inside
    probability = (rankdata(inside, "ordinal") - 0.5) / len(inside)
    return np.maximum(inside, sd * norm.ppf(0.5 + probability / 2))
