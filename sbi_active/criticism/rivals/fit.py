"""A rival with its posterior, what is spent on it, and whether its simulator jumps."""

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
from sbi_active.inference.engine import WeightedDraws, search
from sbi_active.inference.engine.search import SearchSettings, laplace_precision
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.engine.surface import features
from sbi_active.inference.sampling.mixtures import StudentMixture, lower_factors
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    largest_power,
    normalized,
)
from sbi_active.seeding import derive_seed


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
        with np.errstate(divide="ignore"):  # what counts for nothing stays out
            log_w = np.log(own.weight) + lost
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
        fewest = 0.2 * len(u)
        power = largest_power(lambda p: effective_sample_size(p * log_w) >= fewest)
        at = rng.choice(len(u), size=len(u), p=normalized(power * log_w))
        return u[at], residual[at]


#: Searches of modes. A wrong model explains nothing, so that no number of searches is
#: asked to.
THOROUGH = SearchSettings(
    num_screened=128, max_starts=48, explained=0.0, phases=10, num_kept=8
)


#: Searches with a fit to begin at.
NESTED = SearchSettings(
    num_screened=32,
    num_starts=4,
    max_starts=12,
    num_found=1,
    explained=0.0,
    iterations=6,
    phases=10,
)


def settings_of(num_trials: int, *, is_bare: bool) -> Settings:
    """Return the settings of what is spent on a sample.

    The bare model is every comparison's other side, and its posterior is shown; of
    others fifty effective draws are enough, for which a ridge has a quarter of the
    places that two hundred ask for. Half of that misses ridges, twice takes more rows.

    Args:
        num_trials: Number of simulated trials in a row.
        is_bare: Whether it is the model without effects.
    """
    most = 3_000  # rows of all trials
    if is_bare:
        return Settings(plenty=4.0, num_simulations=3 * most * num_trials)
    return Settings(
        num_effective=50.0,
        plenty=1.0,
        divergence=np.inf,
        num_draws=100,
        fewest=25.0,
        affordable=5.0,
        broad=60.0,
        share_of_plenty=0.0,
        num_ridge=32,
        num_simulations=most * num_trials,
    )


#: Finite-difference steps in prior deviations, and where two of them count as one; a
#: coarse one, whose slope is of the same kind where nothing jumps.
STEPS, SAME_SLOPE = (1e-4, 1e-3, 1e-2, 5e-2, 0.2), 0.1


def look_for_jumps(rival: Rival, *, seed: int) -> tuple[float, bool, Array]:
    """Return a step for finite differences, whether they mean anything, and roughness.

    Args:
        rival: The bare model, with the declared noise.
        seed: Seed of all draws.

    Returns:
        The step, in prior deviations; whether the simulator is smooth; and the
        deviation of its jumps, shape (N,), zero if it is.
    """
    noise = rival.error
    assert isinstance(noise, NoiseGrid)
    none = np.zeros(len(rival.simulator.measurements))
    small = 0.1 * noise.typical_sd  # a roughness below it does not matter
    drawn = rival.coordinates.sample(4, seed=derive_seed(seed, "probe"))
    fine, is_steady = probe_step(rival, drawn)
    own = derive_seed(seed, "roughness")
    if is_steady or rival.simulator.is_stochastic:
        return fine or STEPS[-1], fine is not None, none
    # Fine slopes differ from coarse ones as well where a smooth response bends within
    # the coarse step.
    if fine is not None:
        rough, _ = local_roughness(rival, step=fine, seed=own)
        if (rough < small).all():
            return fine, True, none
    rough, around = local_roughness(rival, step=STEPS[-1], seed=own)
    if (rough < small).all():
        # It jumps somewhere in the prior, and not where the fit is.
        fine, is_steady = probe_step(rival, around[: len(drawn)])
        if fine is not None and is_steady:
            return fine, True, none
    return STEPS[-1], False, rough


def probe_step(rival: Rival, u: Array) -> tuple[float | None, bool]:
    """Return a step for finite differences, and whether slopes hold over a coarse one.

    The step is the smallest whose slope agrees with that of twice the step within 10 %
    at most of some places: below it rounding or a solver's tolerance
    speaks, and where there is none the simulator jumps. It may jump as well where
    slopes agree between two jumps and not with those across them.

    Args:
        rival: The bare model.
        u: Places, shape (n, dim).
    """
    whiten, coarse = rival.whitener(), 5e-2

    def slope(step: float) -> Array:
        return rival.jacobian(u, whiten, step)[1]

    def apart(one: Array, two: Array) -> float:
        size = np.sqrt((one**2).sum((1, 2))) + 1e-12
        return float(np.median(np.sqrt(((one - two) ** 2).sum((1, 2))) / size))

    for step in STEPS:
        fine = slope(step)
        if apart(fine, slope(2 * step)) < SAME_SLOPE:
            return step, step >= coarse or apart(fine, slope(coarse)) < 0.5
    return None, False


def local_roughness(rival: Rival, *, step: float, seed: int) -> tuple[Array, Array]:
    r"""Return the standard deviation of what no smooth function follows, shape (N,).

    It also returns the draws around the best fit that show it, shape (n, dim).

    A simulator of contact or chaos answers a change of its parameters that is far
    within their posterior by a jump. Beside the error of measurement s, jumps of size r
    change the log likelihood of N numbers by about :math:`N (r / s)^2`, and its peaks
    are those of the jumps. Taken as an independent error of deviation r, as a nugget is
    in the emulation of computer codes, they leave a likelihood that a search can climb
    and importance sampling can integrate; it claims less than the simulator would, had
    one the draws to resolve it.

    r is estimated from the residuals of a quadratic regression on draws around the best
    fit, as wide as the posterior there, by their median absolute deviation.

    Args:
        rival: The bare model, with the declared noise.
        step: Step of finite differences.
        seed: Seed of the draws.

    References:
        Gramacy & Lee, Statistics and Computing 22 (2012), for the nugget of
        deterministic codes; Kennedy & O'Hagan, J. R. Stat. Soc. B 63 (2001).
    """
    noise = rival.error
    assert isinstance(noise, NoiseGrid)
    rival.step, rng = step, np.random.default_rng(seed)
    dim, c = rival.dim, rival.coordinates
    found = search(rival, rng, settings=THOROUGH)
    assert found is not None  # residuals are bounded
    best = found.modes[:1]
    num = max(3 * (dim + 1) * (dim + 2) // 2, 64)  # three a coefficient
    rough = np.zeros(len(rival.simulator.measurements))
    for _ in range(2):  # as far around the mode as the noise found before says
        wide = noise.with_extra(rough)
        whiten = wide.whitener(rival.residual(best)[0][0])
        cov = 1.5 * np.linalg.inv(laplace_precision(rival, best, whiten)[0])
        u = StudentMixture(best, lower_factors(cov)).sample(num, rng)
        u = np.clip(u, c.low, c.high)
        mean, _, _ = rival.simulator.predict(*c.split(u))
        rough = _beside_quadratic(u - best[0], mean)
    return rough, u


def _beside_quadratic(u: Array, x: Array) -> Array:
    """Return the deviation of x, shape (n, N), around a quadratic function of u."""
    dim = u.shape[1]
    scale = u.std(0)
    basis = features(u / np.where(scale > 0, scale, 1.0), 2)
    found = np.zeros(x.shape[1])
    for k, column in enumerate(x.T):
        has = np.isfinite(column)
        freedom = int(has.sum()) - basis.shape[1]
        if freedom < dim:
            continue
        fit = np.linalg.lstsq(basis[has], column[has], rcond=None)[0]
        rest = np.abs(column[has] - basis[has] @ fit)
        lost = np.sqrt(has.sum() / freedom)
        # By the median absolute deviation of a normal variable of unit variance.
        found[k] = np.median(rest) / 0.6745 * lost
    return found
