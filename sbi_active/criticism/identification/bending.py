"""The posterior where the simulator leaves its linear model, by ``infer``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.fit import NESTED
from sbi_active.criticism.identification.fitting import Fitted, with_effects
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
    error, model, c = SettledError(linear), linear.model(), linear.rival.coordinates
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
    free = np.append(present, True)[linear.effect]
    rival = with_effects(linear.rival, [*compress(linear.rival.effects, present)])
    error: Any = SettledError(linear)
    rival = replace(rival, error=error)
    u, c = linear.origin + linear.draws.u.mean(0), linear.rival.coordinates
    near = np.clip(u, c.low, c.high)[free]
    found = search(rival, rng, near[None], NESTED)
    settings = Settings(num_simulations=most * rival.num_trials)
    return infer(rival, rng, found=found, settings=settings)
