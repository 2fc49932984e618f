r"""Particles between bounds that cut a posterior along many axes.

Hardly any draw of a normal approximation lies within all of them, and its center may be
far beyond one. A linear response has no such trouble: with the residuals r and their
derivatives J at the modes m,

.. math::
    q(u) \propto p(u) \sum_m \exp\Bigl(-\frac{\| r_m + J_m (u - m) \|^2}{2 w^2}\Bigr)

is led to from the prior by sequential Monte Carlo that simulates nothing, and the
posterior from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.engine.search import Found
from sbi_active.inference.sampling.mixtures import Proposal, truncated_normal
from sbi_active.inference.sampling.smc import Bridged, Moves, bridge
from sbi_active.inference.sampling.weights import log_sum_exp

Density = Callable[[Array], Array]


@dataclass(frozen=True)
class Particles(Proposal):
    """Draws of a density, and what it is.

    Attributes:
        drawn: Places, shape (n, d).
        log_density: Normalized log density, (n, d) -> (n,).
    """

    drawn: Array
    log_density: Density

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return the draws, each as often as any other."""
        return self.drawn[np.arange(num_samples) % len(self.drawn)]

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        return self.log_density(z)


@dataclass(frozen=True)
class LinearMode:
    """A response that is linear at a mode.

    Attributes:
        mode: Place of the mode, shape (d,).
        slope: Derivatives of the residuals along a basis of theirs, shape (k, d).
        along: Residuals along it, shape (k,).
        rest: Sum of the squares of what is orthogonal to it.
    """

    mode: Array
    slope: Array
    along: Array
    rest: float

    def square(self, u: Array) -> Array:
        """Return the sums of squared residuals, shape (n,)."""
        return self.rest + ((self.along + (u - self.mode) @ self.slope.T) ** 2).sum(1)


class LinearResponse:
    """The likelihood of a response that is linear at each mode, wider than that.

    Args:
        potential: Potential of all trials.
        found: Modes of the density.
        axes: Axes that places are of; others change nothing.
    """

    def __init__(
        self, potential: Potential, found: Found, axes: NDArray[np.int64]
    ) -> None:
        whiten = potential.whitener(found.modes[:1])
        residual, jacobian = potential.jacobian(found.modes, whiten, potential.step)
        self.modes, self.wider = [], found.wider
        for mode, r, jac in zip(found.modes, residual, jacobian, strict=True):
            basis, slope = np.linalg.qr(jac[:, axes])
            along = basis.T @ r
            rest = float(r @ r - along @ along)
            self.modes.append(LinearMode(mode[axes], slope, along, rest))

    def __call__(self, u: Array) -> Array:
        """Return log likelihoods, shape (n,)."""
        squares = np.stack([mode.square(u) for mode in self.modes])
        return log_sum_exp(-0.5 * squares / self.wider**2, axis=0)


@dataclass(frozen=True)
class _Line:
    """A direction of a few axes, drawn anew at each particle.

    Attributes:
        axes: The axes, shape (k,).
        precision: Precision of these given all others, shape (k, k).
        root: Root of its inverse, shape (k, k).
    """

    axes: NDArray[np.int64]
    precision: Array
    root: Array


class LineMoves(Moves):
    r"""Moves along lines, each to a normal draw between where the bounds cut it.

    The normal density is that of a linear mode at the power of a step. A line changes a
    few axes that its precision couples, in the direction of a draw of these given all
    others: of one through all axes the nearest bound would leave little, and along a
    single axis nothing follows a ridge. A proposal is a walk along many lines, under
    which the normal density between the bounds is reversible.

    Args:
        response: Linear modes.
        low: Bounds, shape (d,).
        high: Bounds, shape (d,).
        precision: Precision of the prior along each axis, zero between bounds, (d,).
        num_lines: Lines of a walk, in numbers of axes. Half leaves particles as far
            behind the density as half as many moves.
        sizes: Numbers of axes of a line, equally likely.

    References:
        Smith, Operations Research 32 (1984); Chen & Schmeiser, J. Comput. Graph. Stat.
        2 (1993).
    """

    def __init__(
        self,
        response: LinearResponse,
        low: Array,
        high: Array,
        precision: Array,
        *,
        num_lines: int = 3,
        sizes: tuple[int, ...] = (1, 2, 2, 3, 4, 8),
    ) -> None:
        self._response, self._low, self._high = response, low, high
        self._prior = np.maximum(precision, 1 / (high - low) ** 2)
        self._num, self._sizes = num_lines * len(low), sizes
        self._normals: list[tuple[Array, Array]] = []
        self._lines: dict[int, list[_Line]] = {}

    def begin(self, u: Array, weight: Array, power: float) -> None:
        """Take the normal density of each mode at a power of its likelihood."""
        self._normals, self._lines = [], {}
        for mode in self._response.modes:
            pull = power / self._response.wider**2 * mode.slope.T
            precision = pull @ mode.slope + np.diag(self._prior)
            center = pull @ (mode.slope @ mode.mode - mode.along)
            self._normals.append((np.linalg.solve(precision, center), precision))

    def propose(self, u: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return proposed particles, and the log ratio of the normal densities."""
        k = int(rng.integers(len(self._normals)))
        mean, precision = self._normals[k]
        if k not in self._lines:
            self._lines[k] = self._drawn_lines(precision, rng)
        new = u.T.copy()  # a line reads a few axes of all particles
        apart = new - mean[:, None]
        pull = precision @ apart
        before = (apart * pull).sum(0)
        # In any order: a walk is as likely as the one that leads back.
        for place in rng.permutation(len(self._lines[k])):
            line = self._lines[k][place]
            step = line.root @ rng.standard_normal((len(line.axes), len(u)))
            square = (step * (line.precision @ step)).sum(0)
            old, sd = new[line.axes], square**-0.5
            center = -(step * pull[line.axes]).sum(0) / square
            with np.errstate(divide="ignore", invalid="ignore"):
                low = (self._low[line.axes, None] - old) / step
                high = (self._high[line.axes, None] - old) / step
            first_end = np.minimum(low, high).max(0)
            last_end = np.maximum(low, high).min(0)
            to = old + truncated_normal(center, sd, first_end, last_end, rng) * step
            np.clip(to, self._low[line.axes, None], self._high[line.axes, None], out=to)
            pull += precision[:, line.axes] @ (to - old)
            new[line.axes] = to
        apart = new - mean[:, None]
        after = (apart * (precision @ apart)).sum(0)
        return new.T.copy(), 0.5 * (after - before)

    def _drawn_lines(self, precision: Array, rng: np.random.Generator) -> list[_Line]:
        """Return lines along axes that a precision couples."""
        scale, dim = np.sqrt(np.diag(precision)), len(precision)
        # Axes that are not coupled are moved together as well, now and then.
        coupled = np.abs(precision) / scale / scale[:, None] + 1e-3
        np.fill_diagonal(coupled, 0.0)
        lines = []
        for _ in range(self._num):
            first = int(rng.integers(dim))
            num = min(int(rng.choice(self._sizes)), dim) - 1
            axes = np.array([first])
            if num:
                share = coupled[first] / coupled[first].sum()
                axes = np.append(axes, rng.choice(dim, num, replace=False, p=share))
            own = precision[np.ix_(axes, axes)]
            lines.append(_Line(axes, own, np.linalg.inv(np.linalg.cholesky(own)).T))
        return lines

    def remembered(self, before: Array, after: Array, acceptance: float) -> float:
        """Return the mean correlation of the axes across a move."""
        off = before - before.mean(0), after - after.mean(0)
        norm = np.sqrt((off[0] ** 2).sum(0) * (off[1] ** 2).sum(0))
        each = (off[0] * off[1]).sum(0) / np.maximum(norm, 1e-300)
        return float(np.clip(each.mean(), 0.0, 1.0))


def led_between(
    log_prior: Density,
    log_likelihood: Density,
    response: LinearResponse,
    moves: LineMoves,
    prior: Array,
    rng: np.random.Generator,
    *,
    most: float,
) -> Bridged | None:
    """Return particles of a posterior, from those of a prior by what is linear.

    Args:
        log_prior: Log density of the prior, (n, d) -> (n,).
        log_likelihood: Log likelihood, simulated.
        response: Log likelihood, not simulated.
        moves: Moves of the particles.
        prior: Draws of the prior, shape (n, d).
        rng: Source of the moves.
        most: Evaluations of the simulated likelihood at most.
    """
    log_prior = _remembering(log_prior)
    linear = bridge(
        log_prior,
        response,
        Particles(prior, log_prior),
        rng,
        num_particles=len(prior),
        moves=moves,
    )
    if linear is None:
        return None

    def normalized_linear(u: Array) -> Array:
        return log_prior(u) + response(u) - linear.log_evidence

    moved = bridge(
        log_prior,
        log_likelihood,
        Particles(linear.u, normalized_linear),
        rng,
        num_particles=len(prior),
        most=most,
        moves=moves,
    )
    if moved is None:
        return None
    error = float(np.hypot(linear.standard_error, moved.standard_error))
    memory = max(linear.memory, moved.memory)
    return replace(moved, standard_error=error, memory=memory)


def _remembering(log_density: Density) -> Density:
    """Return a density that is not computed twice in turn for the same array."""
    known: list[Array] = []

    def log_prob(u: Array) -> Array:
        if not known or known[0] is not u:
            known[:] = [u, log_density(u)]
        return known[1]

    return log_prob
