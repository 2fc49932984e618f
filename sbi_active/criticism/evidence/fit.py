"""A rival with its posterior, and what is spent on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.results import Evidence
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.engine import WeightedDraws
from sbi_active.inference.engine.search import SearchSettings
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.weights import effective_sample_size, normalized


@dataclass(frozen=True)
class Spread:
    """Errors of predictions where every model misses, by those on left-out trials.

    A number errs by the sensor and the residual process, which together are as large as
    the residuals of its channel, and by what the parameters are unsure of: more where
    the trials so far tell less. Both are as many times larger, or smaller, as left-out
    trials say.

    Attributes:
        size: Root mean square residual of each channel, in units of x, shape (c,).
        square: Mean squared error of each left-out part, in units of what both expect
            of it, shape (f,).
        time: Correlation time of the errors, in the unit of the sample times.
    """

    size: Array
    square: Array
    time: float = 0.0

    @property
    def scale(self) -> float:
        """Root mean square error on left-out parts, in units of what is expected."""
        return float(np.sqrt(np.mean(self.square))) if len(self.square) else 1.0

    @property
    def sizes(self) -> Array:
        """Standard deviation of errors given the parameters by channel, shape (c,)."""
        return self.scale * self.size

    def errors(self, m: Measurements, num: int, rng: np.random.Generator) -> Array:
        """Return errors of some numbers at random, shape (n, N)."""
        given = {"sd": self.sizes[m.channel], "correlation_time": self.time}
        cells = np.zeros(num, dtype=np.intp)
        return NoiseGrid([NoiseCell.of(m, **given)]).errors(cells, np.ones(num), rng)[0]


@dataclass(frozen=True)
class Fit:
    """A rival fitted to the trials.

    Attributes:
        rival: The model.
        sample: Sample of its posterior, weighted.
        evidence: Evidence that is recorded of it.
        best: Point from which other trials are predicted, shape (dim,); None takes the
            draws.
        linear: Function from u (n, dim) to the residuals (n, N) of the linear model
            that draws are of; None if they are of the simulator's own posterior.
        known: Mask of the numbers that it is fitted to, shape (N,); None for all.
        spread: Errors of its predictions if every model misses; None else.
    """

    rival: Rival
    sample: WeightedDraws
    evidence: Evidence
    best: Array | None = None
    linear: Callable[[Array], Array] | None = None
    known: NDArray[np.bool_] | None = None
    spread: Spread | None = None

    @property
    def error(self) -> NoiseGrid | ResidualProcess:
        """The error of the numbers that it is fitted to."""
        error = self.rival.error
        if self.known is None:
            return error
        assert isinstance(error, NoiseGrid)  # a process joins all of them
        return error.part(self.known)

    def by(self, known: NDArray[np.bool_]) -> Fit:
        """Return a sampled model with its posterior by some of the numbers.

        What bends has no linear model that could be fitted again; its draws are weighed
        by the density of the other numbers.

        Args:
            known: Mask of the numbers that count, shape (N,).
        """
        own, some = self.sample, replace(self, known=known)
        residual, log_scale, _ = self.rival.residual(own.u, penalized=False)
        lost = np.broadcast_to(log_scale, residual.shape)[:, ~known].sum(1)
        log_w = np.log(np.maximum(own.weight, 1e-300)) + lost
        log_w += some.error.log_likelihood(residual[:, known])
        log_w -= self.error.log_likelihood(residual)
        log_w = np.where(np.isfinite(log_w), log_w, -np.inf)
        effective = effective_sample_size(log_w)
        weight = normalized(log_w)
        own = replace(own, weight=weight, effective_sample_size=effective)
        return replace(some, sample=own)

    def weighed(
        self, u: Array, residual: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return draws of a linear model, weighed by the simulator where it bends.

        Along the valley of two parameters that make up for each other a Gaussian
        leaves it soon. None is weighed up to a deviation of the log density ratio of
        half a nat; and since few draws would make for a narrow interval, weights leave
        a fifth of them at least, by a power of them.

        Args:
            u: Draws, shape (n, dim).
            residual: Residuals of the simulator there, of the numbers that it is fitted
                to, shape (n, N).
            rng: Source of what is drawn from them.
        """
        if self.linear is None:
            return u, residual
        error, linear_residual = self.error, self.linear(u)
        if self.known is not None:
            linear_residual = linear_residual[:, self.known]
        log_w = error.log_likelihood(residual) - error.log_likelihood(linear_residual)
        log_w = np.nan_to_num(log_w, nan=-1e9, neginf=-1e9, posinf=-1e9)
        if log_w.std() < 0.5:
            return u, residual
        at = rng.choice(len(u), size=len(u), p=tempered(log_w, 0.2 * len(u)))
        return u[at], residual[at]


def tempered(log_w: Array, fewest: float) -> Array:
    """Return weights, by a power of them that leaves some effective draws, (n,)."""
    power = 1.0
    while effective_sample_size(power * log_w) < fewest:
        power *= 0.8
    return normalized(power * log_w)


#: Searches of modes. A wrong model explains nothing, so that no number of searches is
#: asked to.
THOROUGH = SearchSettings(
    num_screened=128, max_starts=48, explained=0.0, phases=10, num_kept=8
)


def settings_of(num_trials: int) -> Settings:
    """Return the settings of a sample: 9,000 rows of so many simulated trials."""
    return Settings(plenty=4.0, num_simulations=9_000 * num_trials)
