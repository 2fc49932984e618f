r"""Likelihood of a pour's image by a summary, learned from a bank at one action.

With n pours of an action, theta in [0, 1]^3 and a summary phi (square roots of mesh
coverage, or principal components of blurred images):

.. math::
    \log p(x | \theta) = \log P(\text{as empty} | \theta)
    + \log t_\nu(s(x); m(\theta), \Sigma + V(\theta)),

s three learned numbers (Fearnhead & Prangle 2012), m and V Gaussian processes with
learned noise, and Student errors from residuals of left-out pours (Wood, Nature 2010),
their size :math:`\Sigma(\theta)` log-quadratic in theta.
An image without a cube has the first term alone: its statistics are one atom, which no
density describes. A belief takes p to the power w that gives left-out pours the highest
posterior density: 1 where the model is right, 0 where it tells nothing.

What m is wrong by at theta is the same each time the action is repeated. With
:math:`e \sim N(0, V + c \Sigma)` shared by repeats and :math:`(1 - c) \Sigma` of each
alone, k earlier statistics of mean :math:`\bar s` leave

.. math::
    m' = m + \frac{k (V + c \Sigma)}{(1 - c) \Sigma + k (V + c \Sigma)} (\bar s - m),

and less of V, for each statistic by itself; and as the scale of Student's errors is
theta's own, it is the same for all repeats, which tell of it. So a repeat tells less
than a first pour. c is ``SHARED``, from pours of one theta and action,
and so is ``DOUBT``, the share of outcomes that tell nothing of theta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize
from scipy.special import gammaln, logsumexp

from sbi_active.inference.emulation.gains import correlation_root
from sbi_active.inference.emulation.outcomes import (
    Statistic,
    TrialOutcome,
    learned_statistic,
)
from sbi_active.inference.emulation.solving import whole_space
from sbi_active.inference.sampling.gaussian_process import (
    GaussianProcess,
    ProcessSettings,
)

Array = NDArray[Any]

SIDE = 150  # pixels of an image
BLOCK = 5  # pixels that a thumbnail averages over
BLUR = 1.0  # standard deviation, pixels of a thumbnail
FEWEST = 24  # pours with a cube in view, to learn a density from
LEAST = -9.0  # log probability of what no pour of an action did
#: Share of the noise's variance that repeats of an action have in common.
SHARED = 0.5
#: Share of outcomes that are taken to tell nothing.
DOUBT = 0.1
LOG_SQUARE = -1.27, np.pi**2 / 2  # mean and variance of log chi^2 of one degree
MOST_SQUARED = 4  # parameters whose squares trends and variances may have
LEAST_TOLD = 0.03  # share of a parameter's variance that a statistic is kept for
SLOPE = 0.5  # deviation a priori of coefficients of the noise's log variance


def thumbnails(images: Array) -> Array:
    """Return square roots of blurred heights, (n, 22500) -> (n, 900)."""
    small = SIDE // BLOCK
    blocks = images.reshape(-1, small, BLOCK, small, BLOCK).mean((2, 4))
    blurred = gaussian_filter(blocks.astype(np.float64), (0.0, BLUR, BLUR))
    return np.sqrt(np.maximum(blurred, 0)).reshape(len(images), -1)


def components(pictures: Array, num: int) -> tuple[Array, Array]:
    """Return the mean (900,) and leading components (900, num) of thumbnails."""
    mean = pictures.mean(0)
    _, size, axes = np.linalg.svd(pictures - mean, full_matrices=False)
    kept = min(num, int((size > 1e-6 * max(size[0], 1e-30)).sum()))
    return mean, axes[:kept].T


@dataclass(frozen=True)
class ImageLikelihood:
    """Likelihood at one action by one summary.

    Attributes:
        statistic: Of summaries; None where too few pours had a cube in view.
        processes: One a statistic.
        sd: Scale of the Student errors at typical theta, shape (q,).
        uneven: Of the logarithm of its square, shape (p, q).
        typical: Mean of its features, shape (p,).
        root: Cholesky factor of their correlation, shape (q, q).
        freedom: Their degrees of freedom.
        empty: Probability of an image without cubes; None where no pour had one.
        filled: Of the opposite.
        power: That a belief takes it to.
        shared: Share of the noise's variance that repeats have in common.
    """

    statistic: Statistic | None
    processes: tuple[GaussianProcess, ...]
    sd: Array
    uneven: Array
    typical: Array
    root: Array
    freedom: float
    empty: TrialOutcome | None
    filled: TrialOutcome | None
    power: float = 1.0
    shared: float = SHARED

    @staticmethod
    def fit(
        theta: Array, summary: Array, is_empty: Array, *, num_wanted: int | None = None
    ) -> ImageLikelihood:
        """Learn from pours.

        Args:
            theta: Parameters, and then what else is known of a pour, within [0, 1],
                shape (n, d).
            summary: Shape (n, q).
            is_empty: Whether no cube is in view, shape (n,).
            num_wanted: Entries of theta that statistics are learned for, of which those
                are kept that left-out pours tell; None takes all, and keeps all.
        """
        z = 2 * theta - 1
        empty = filled = None
        if is_empty.any() and not is_empty.all():
            pairs, space = np.zeros((0, 2), dtype=bool), whole_space(z.shape[1])
            empty = TrialOutcome.fit(space, z, is_empty, pairs)
            filled = TrialOutcome.fit(space, z, ~is_empty, pairs)
        seen = ~is_empty
        if seen.sum() < FEWEST:
            none = np.zeros(0)
            return ImageLikelihood(
                None, (), none, none, none, np.eye(1), 5.0, empty, filled
            )
        statistic, own = learned_statistic(
            summary[seen], z[seen][:, :num_wanted], seed=0
        )
        if num_wanted is not None:
            statistic, own = _that_tell(statistic, own, z[seen][:, :num_wanted])
        degree = 1 if z.shape[1] > MOST_SQUARED else None
        processes = tuple(
            GaussianProcess.fit(
                z[seen],
                own[:, [j]],
                noise="learned",
                settings=ProcessSettings(degree=degree),
            )
            for j in range(own.shape[1])
        )
        left_out = np.concatenate([p.left_out for p in processes], 1)
        sd = np.concatenate([p.noise_sd for p in processes])
        features = _quadratic(z[seen])
        typical = features.mean(0)
        uneven = _log_variance(features - typical, left_out)
        white = left_out / sd * np.exp(-0.5 * (features - typical) @ uneven)
        root = correlation_root(white)
        square = (np.linalg.solve(root, white.T) ** 2).sum(0)
        freedom, scale = _student(square, own.shape[1])
        return ImageLikelihood(
            statistic,
            processes,
            sd * scale,
            uneven,
            typical,
            root,
            freedom,
            empty,
            filled,
        )

    def parts(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return means, V and Sigma of statistics at theta (n, 3), each (n, q)."""
        z = 2 * theta - 1
        means, errors = zip(*(p.predict(z) for p in self.processes), strict=True)
        noise = self.sd**2 * np.exp((_quadratic(z) - self.typical) @ self.uneven)
        return np.concatenate(means, 1), np.concatenate(errors, 1), noise

    def predict(
        self, theta: Array, earlier: Sequence[Array] = ()
    ) -> tuple[Array, Array, float]:
        """Return means and deviations of statistics, both (n, q), and their freedom.

        Args:
            theta: Shape (n, 3).
            earlier: Statistics of earlier trials of this action, each of shape (q,).
        """
        known = self.parts(theta)
        freedom, square = self.freedom, np.zeros(len(theta))
        for k, seen in enumerate(earlier):
            mean, spread = repeated(*known, earlier[:k], self.shared)
            square += self.square(seen - mean, spread)
        mean, spread = repeated(*known, earlier, self.shared)
        later = freedom + mean.shape[1] * len(earlier)
        return mean, spread * np.sqrt((freedom + square) / later)[:, None], later

    def probability_empty(self, theta: Array) -> Array:
        """Return log P(empty) and log P(not empty), shape (2, n)."""
        if self.empty is None or self.filled is None:
            sure = 0.0 if self.statistic is not None else LEAST
            return np.stack([np.full(len(theta), LEAST), np.full(len(theta), sure)])
        z = 2 * theta - 1
        both = np.stack([self.empty.log_prob(z), self.filled.log_prob(z)])
        return both - logsumexp(both, 0)

    def at(
        self, theta: Array, observed: Array | None, earlier: Sequence[Array] = ()
    ) -> Array:
        """Return w log p of one outcome at theta (n, 3), shape (n,).

        Args:
            theta: Shape (n, 3).
            observed: Its statistics, shape (q,); None of an image without cubes.
            earlier: As in :meth:`predict`.
        """
        return self.at_each(theta, [observed], earlier)[0]

    def at_each(
        self, theta: Array, outcomes: list[Any], earlier: Sequence[Array] = ()
    ) -> Array:
        """Return w log p of outcomes at theta (n, 3), shape (outcomes, n)."""
        log_empty, log_filled = self.probability_empty(theta)
        found = np.empty((len(outcomes), len(theta)))
        mean = spread = np.zeros(0)
        freedom = self.freedom
        if self.statistic is not None:
            mean, spread, freedom = self.predict(theta, earlier)
        for row, seen in zip(found, outcomes, strict=True):
            if seen is None:
                row[:] = log_empty
            elif self.statistic is None:
                row[:] = np.maximum(log_filled, LEAST)
            else:
                row[:] = log_filled + self.density(seen[None] - mean, spread, freedom)
        return self.power * found

    def square(self, residual: Array, spread: Array) -> Array:
        """Return the sum of whitened squares, both (..., q) -> (...)."""
        white = (residual / spread) @ np.linalg.inv(self.root).T
        return (white**2).sum(-1)

    def density(self, residual: Array, spread: Array, freedom: float) -> Array:
        """Return the Student log density, both (..., q) -> (...)."""
        nu, q = freedom, residual.shape[-1]
        constant = (
            gammaln(0.5 * (nu + q)) - gammaln(0.5 * nu) - 0.5 * q * np.log(nu * np.pi)
        )
        volume = np.log(spread).sum(-1) + np.log(np.diag(self.root)).sum()
        tail = np.log1p(self.square(residual, spread) / nu)
        return constant - volume - 0.5 * (nu + q) * tail

    def gain(
        self,
        theta: Array,
        num_outer: int,
        rng: np.random.Generator,
        earlier: Sequence[Array] = (),
    ) -> Array:
        r"""Return contributions to the expected information gain, nats, (num_outer,).

        .. math::
            w \log p(x_i | \theta_i) - \log \frac{1}{M} \sum_j p(x_i | \theta_j)^w

        Args:
            theta: Draws from the belief, shape (m, 3); outcomes are drawn at the first.
            num_outer: How many.
            rng: Of the outcomes.
            earlier: As in :meth:`predict`.
        """
        uniform = rng.random(num_outer)
        if self.power == 0:
            return np.zeros(num_outer)
        log_empty, log_filled = self.probability_empty(theta)
        every = np.broadcast_to(log_empty, (num_outer, len(theta))).copy()
        is_full = np.log(uniform) > log_empty[:num_outer]
        if self.statistic is None:
            every[is_full] = np.maximum(log_filled, LEAST)
        else:
            mean, spread, freedom = self.predict(theta, earlier)
            normal = rng.standard_normal((num_outer, mean.shape[1])) @ self.root.T
            heavy = np.sqrt(freedom / rng.chisquare(freedom, num_outer))
            x = mean[:num_outer] + spread[:num_outer] * normal * heavy[:, None]
            apart = np.asarray(x[is_full])[:, None] - np.asarray(mean)
            every[is_full] = log_filled + self.density(apart, spread, freedom)
        every = self.power * every
        own = every[np.arange(num_outer), np.arange(num_outer)]
        return own - np.asarray(logsumexp(every, axis=1)) + np.log(len(theta))


def observed(likelihood: ImageLikelihood, summary: Array, is_empty: bool) -> Any:
    """Return what :meth:`ImageLikelihood.at` takes of a summary (q,)."""
    if is_empty or likelihood.statistic is None:
        return None if is_empty else np.zeros(0)
    return likelihood.statistic(summary[None])[0]


def doubted(log_p: Array, power: float) -> Array:
    r"""Return w log p where a share of outcomes tells nothing, shape (..., n).

    .. math::
        w \log \Bigl((1 - \epsilon) p(x | \theta) + \epsilon \int p(x | \theta')
        p(\theta') \, \mathrm d\theta' \Bigr)

    Args:
        log_p: w log p at draws from the prior, or at equal cells of it, (..., n).
        power: w.
    """
    if power == 0:
        return log_p
    own = log_p / power
    mean = logsumexp(own, -1, keepdims=True) - np.log(own.shape[-1])
    return power * np.logaddexp(np.log(1 - DOUBT) + own, np.log(DOUBT) + mean)


def repeated(
    mean: Array, error: Array, noise: Array, earlier: Sequence[Array], shared: float
) -> tuple[Array, Array]:
    """Return mean and deviation of a statistic given earlier ones of the same action.

    Args:
        mean: Shape (n, q), as all that follow.
        error: V.
        noise: Sigma.
        earlier: Statistics, each of shape (q,).
        shared: c.
    """
    common, alone, num = error + shared * noise, (1 - shared) * noise, len(earlier)
    if num:
        known = num * common / (alone + num * common)
        mean = mean + known * (np.mean([*earlier], 0) - mean)
        common = common * (1 - known)
    return mean, np.sqrt(alone + common)


def _that_tell(statistic: Statistic, own: Array, z: Array) -> tuple[Statistic, Array]:
    """Return the statistics that tell of their parameter, at least the best."""
    if statistic.weight is None:  # few numbers, which stay as they are
        return statistic, own
    told = 1 - ((z - own) ** 2).mean(0) / z.var(0)
    keep = told >= min(LEAST_TOLD, told.max())
    fewer = replace(
        statistic, weight=statistic.weight[:, keep], offset=statistic.offset[keep]
    )
    return fewer, own[:, keep]


def _quadratic(z: Array) -> Array:
    """Return linear and, of few parameters, quadratic terms, (n, d) -> (n, p)."""
    if z.shape[1] > MOST_SQUARED:
        return z
    row, column = np.triu_indices(z.shape[1])
    return np.concatenate([z, z[:, row] * z[:, column]], 1)


def _log_variance(features: Array, residual: Array) -> Array:
    """Return coefficients (p, q) of log variances of residuals (n, q)."""
    mean, variance = LOG_SQUARE
    target = np.log(residual**2 + 1e-6 * (residual**2).mean(0)) - mean
    gram = features.T @ features / variance + np.eye(features.shape[1]) / SLOPE**2
    return np.linalg.solve(gram, features.T @ (target - target.mean(0)) / variance)


def _student(square: Array, q: int) -> tuple[float, float]:
    """Return degrees of freedom and scale of whitened residuals' squares (n,)."""

    def loss(free: Array) -> float:
        nu, scale = 2 + np.exp(free[0]), np.exp(free[1])
        tail = 0.5 * (nu + q) * np.log1p(square / scale**2 / nu)
        constant = gammaln(0.5 * (nu + q)) - gammaln(0.5 * nu) - 0.5 * q * np.log(nu)
        return -(constant - q * free[1] - tail).sum() + 0.5 * (free[0] - 2) ** 2

    found = minimize(loss, np.array([2.0, 0.0]), method="L-BFGS-B").x
    return float(2 + np.exp(found[0])), float(np.exp(found[1]))
