r"""Outcomes as a likelihood sees them: summaries, and whether there is a measurement.

A trial that fell off the table has no number to regress, yet where in parameter space
trials fall off is information. The likelihood of a trial is that of what happened,

.. math::
    p(x_k | \theta) = \begin{cases}
    P(\text{invalid} | \theta) & \text{without a measurement}, \\
    P(F_k | \theta)\, p(x_{F_k} | \theta, F_k) & \text{with the numbers } F_k,
    \end{cases}

where :math:`F_k` stands for "these numbers, and perhaps others, are present". The
information in the absence of others is left out: the posterior uses a part of the data,
so it may be too wide but is not biased.

The probabilities are logistic regressions in a region's coordinates,

.. math::
    P(y = 1 | u) = \epsilon + (1 - 2 \epsilon)\, \sigma(\beta^\top f(u)), \qquad
    \beta \sim \mathcal N(0, \tau^2 I),

whose degree and :math:`\tau` have the largest evidence: a chance that varies smoothly
gets a small :math:`\tau`, and a hard edge, :math:`y = 1\{g(u) > 0\}`, as steep a slope
as the simulations on its two sides allow.

Summaries are few numbers from an outcome of many: what it says of each parameter. The
statistic is the best linear estimate of the parameters from the summary,

.. math::
    s(x) = \hat{\mathrm E}[z | \phi(x)] = \bar z + W^\top (\phi(x) - \bar\phi),

by ridge regression over simulations, its penalty by left-out rows (Fearnhead &
Prangle, J. R. Stat. Soc. B 2012). The statistics of simulations are those of a
regression that did not see them, so that what is then learned about their noise is not
too small.

References:
    MacKay, Neural Computation 1992 (evidence of a classifier, by Laplace's method).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit, log_expit
from sklearn.linear_model import Ridge, RidgeCV
from torch import Tensor

from sbi_active.actions.summaries import SummaryAction, is_fitted
from sbi_active.arrays import Array
from sbi_active.inference.emulation.solving import Region
from sbi_active.inference.engine.surface import features

PENALTIES = 10.0 ** np.arange(-4.0, 3.1, 0.5)  # of features of unit variance, by row


@dataclass(frozen=True)
class Summary:
    """A summary of raw outcomes, fitted where it is of that kind.

    Attributes:
        label: Name of the summary.
        of: The function, or the fitted object.
        fill: Mean of the raw outcomes it was fitted to, shape (k,), which takes the
            place of what was not measured; None for a function, which gets NaN.
    """

    label: str
    of: Any
    fill: Array | None = None

    def __call__(self, raw: Tensor) -> Array:
        """Return summaries (n, d), float64, of raw outcomes (n, *x_shape).

        NaN where nothing was measured, and whatever the summary makes of a part.

        Raises:
            ValueError: If it returns another shape, or rows depend on their order.
        """
        rows = raw.detach().cpu().float().flatten(1)
        measured = rows.isfinite().any(1)
        some = rows[measured].clone()  # a summary may change what it is given
        if not len(some):
            return np.full((len(rows), 1), np.nan)
        found = self._numbers(some)
        if found.ndim != 2 or len(found) != len(some) or not found.shape[1]:
            raise ValueError(
                f"expected the summary {self.label!r} to map outcomes "
                f"{tuple(some.shape)} to ({len(some)}, d) with d >= 1; got "
                f"{found.shape}; return one row of numbers an outcome"
            )
        result = np.full((len(rows), found.shape[1]), np.nan)
        result[measured.numpy()] = np.where(np.isfinite(found), found, np.nan)
        return result

    def _numbers(self, rows: Tensor) -> Array:
        if self.fill is None:
            found = self.of(rows)
            if isinstance(found, Tensor):
                found = found.detach().cpu().numpy()
            return np.array(found, dtype=np.float64)  # it may be a view of the rows
        x = rows.numpy().astype(np.float64)
        x = np.where(np.isfinite(x), x, self.fill)
        return np.array(self.of.transform(x), dtype=np.float64)


def fitted_summaries(
    choice: SummaryAction | None, raw: Tensor, *, most_fitted: int = 1_000
) -> list[Summary]:
    """Return the summaries of a choice, those that are fitted fitted to copies.

    Args:
        choice: None is the outcome itself.
        raw: Simulated outcomes, shape (n, *x_shape).
        most_fitted: Number of rows at most that a summary is fitted to: an image has
            20,000 numbers.

    Raises:
        ValueError: If one cannot be fitted to so many outcomes.
    """
    if choice is None:
        return [Summary("x", torch.Tensor.double)]
    found = []
    for label, summary in choice.summaries.items():
        if not is_fitted(summary):
            found.append(Summary(label, summary))
            continue
        rows = raw.detach().float().flatten(1)
        rows = rows[rows.isfinite().any(1)]
        rows = rows[:: -(-len(rows) // most_fitted)].double().numpy()
        fill = np.ma.masked_invalid(rows).mean(0).filled(0.0)
        filled = np.where(np.isfinite(rows), rows, fill)
        own = copy.deepcopy(summary)
        try:
            own.fit(filled)
        except ValueError as error:
            raise ValueError(
                f"expected outcomes to fit the summary {label!r} to; got {len(rows)}: "
                f"{error}; allow more simulations a round, or ask for fewer numbers"
            ) from error
        found.append(Summary(label, own, fill))
    return found


@dataclass(frozen=True)
class Statistic:
    """A linear map of summaries (n, q) to statistics (n, s).

    Attributes:
        center: Mean of the summaries, shape (q,).
        scale: Deviation of the summaries, shape (q,); infinite if one never varies.
        weight: Shape (q, s); None keeps the numbers as they are.
        offset: Shape (s,).
    """

    center: Array
    scale: Array
    weight: Array | None
    offset: Array

    def __call__(self, summary: Array) -> Array:
        """Return statistics, shape (n, s)."""
        features = (summary - self.center) / self.scale
        if self.weight is None:
            return features
        return self.offset + features @ self.weight


def is_short(num_numbers: int, dim: int, *, few: int = 2) -> bool:
    """Return whether an outcome stays as it is: a few numbers for each parameter."""
    return num_numbers <= few * dim


def learned_statistic(
    summary: Array, z: Array, *, seed: int, num_folds: int = 10
) -> tuple[Statistic, Array]:
    """Return the statistic of simulations and their own values of it.

    Args:
        summary: Finite summaries, shape (n, q).
        z: Coordinates of their parameters, shape (n, d).
        seed: Seed of the folds.
        num_folds: Number of folds.

    Returns:
        The statistic, and those of the rows by regressions without them, (n, s).
    """
    n, q = summary.shape
    center, scale = summary.mean(0), summary.std(0)
    floor = 1e-7 * np.abs(summary).max(0, initial=0.0)
    # What never varies says nothing, and its rounding must not.
    scale = np.where(scale > floor, scale, np.inf)
    if is_short(q, z.shape[1]) or not np.isfinite(scale).any():
        varies = np.where(np.isfinite(scale), scale, np.maximum(np.abs(center), 1e-30))
        plain = Statistic(center, varies, None, np.zeros(q))
        return plain, plain(summary)
    features = (summary - center) / scale
    size = z.std(0) + 1e-12
    best: Any = RidgeCV(alphas=n * PENALTIES).fit(features, z / size)
    penalty = best.alpha_ / n
    fold = np.random.default_rng(seed).permutation(n) % min(num_folds, n)
    own = np.zeros_like(z)
    for k in range(fold.max() + 1):
        kept = fold != k
        ridge = Ridge(alpha=kept.sum() * penalty).fit(features[kept], z[kept])
        # One center for all: the means of the others would tell who was left out.
        own[~kept] = z.mean(0) + features[~kept] @ ridge.coef_.reshape(len(size), q).T
    ridge = Ridge(alpha=n * penalty).fit(features, z)
    weight = ridge.coef_.reshape(len(size), q).T
    return Statistic(center, scale, weight, np.atleast_1d(ridge.intercept_)), own


@dataclass(frozen=True)
class TrialOutcome:
    r"""Probability in one region that a trial's outcome is what it was.

    Attributes:
        region: Region that gives the coordinates.
        reach: Distance that is their unit.
        degree: Degree of f, all products of coordinates.
        coefficient: Shape (p,).
        slip: :math:`\epsilon`, which no regression falls below.
        blur: Share of pairs at the same parameters that the regression expects to
            differ, less the share that does and less chance: above zero it misses an
            edge.
    """

    region: Region
    reach: float
    degree: int
    coefficient: Array
    slip: float
    blur: float = 0.0

    @staticmethod
    def fit(
        region: Region,
        z: Array,
        agrees: NDArray[np.bool_],
        pairs: NDArray[np.bool_],
        *,
        degrees: tuple[int, ...] = (0, 1, 2, 3),
        deviations: tuple[float, ...] = (1.0, 4.0, 16.0, 64.0),
        intercept: float = 8.0,
        rows_a_feature: int = 6,
        surprise: float = 0.01,
    ) -> TrialOutcome:
        """Fit the regression with the largest evidence.

        Args:
            region: Region that gives the coordinates.
            z: Coordinates of simulations, shape (n, d).
            agrees: Whether their outcome is what was observed, shape (n,).
            pairs: Pairs of simulations at the same parameters, shape (r, 2).
            degrees: Degrees of the polynomials that the evidence chooses among.
            deviations: Deviations of coefficients a priori that the evidence chooses
                among.
            intercept: Deviation of the intercept at least: an event may be rare all
                over a region.
            rows_a_feature: Number of rows a feature at least.
            surprise: Probability below which an outcome is a slip.
        """
        reach = max(float(region.distance(z).max(initial=0.0)), 1e-300)
        u, n = region.scaled(z) / reach, len(z)
        degrees = degrees if 0 < agrees.sum() < n else (0,)
        best, evidence, likeliest = 0, -np.inf, np.zeros(1)
        for degree in degrees:
            rows = features(u, degree)
            if degree > 1 and n < rows_a_feature * rows.shape[1]:
                break
            coefficient = np.zeros(rows.shape[1])
            for deviation in deviations if degree > 0 else (intercept,):
                scale = np.full(rows.shape[1], deviation)
                scale[0] = max(deviation, intercept)
                coefficient, value = _laplace(rows, agrees, scale, coefficient)
                if value > evidence:
                    best, evidence, likeliest = degree, value, coefficient
        probability = expit(features(u, best) @ likeliest)
        actual = np.where(agrees, probability, 1 - probability)
        if degrees == (0,):  # one kind only: the rule of succession
            slip = 1 / (n + 2)
            likeliest = np.full(1, 60.0 if agrees.all() else -60.0)
        else:
            slip = (1 + (actual < surprise).sum()) / (n + 2)
        expected = float((2 * probability * (1 - probability)).mean())
        num = len(pairs) + 1.0
        differ = ((pairs[:, 0] != pairs[:, 1]).sum() + 0.5) / num
        chance = 3 * np.sqrt(differ * (1 - differ) / num)
        blur = max(expected - float(differ) - float(chance), 0.0)
        return TrialOutcome(region, reach, best, likeliest, float(slip), blur)

    def log_prob(self, z: Array) -> Array:
        """Return the log probability, (n, d) -> (n,)."""
        rows = features(self.region.scaled(z) / self.reach, self.degree)
        logit = rows @ self.coefficient
        return np.logaddexp(
            np.log(self.slip), np.log1p(-2 * self.slip) + log_expit(logit)
        )


def _laplace(
    rows: Array,
    agrees: NDArray[np.bool_],
    scale: Array,
    start: Array,
    *,
    num_steps: int = 40,
) -> tuple[Array, float]:
    r"""Return the most probable coefficients and the log evidence.

    .. math::
        \log E = \log p(y | \hat\beta) - \frac{|\hat\beta|^2}{2 \tau^2}
        - p \log \tau - \tfrac12 \log |H|,

    with a deviation :math:`\tau` a coefficient, the scale.
    """
    sign = np.where(agrees, 1.0, -1.0)
    prior = 1 / scale**2

    def objective(beta: Array) -> float:
        fit = log_expit(sign * (rows @ beta)).sum()
        return float(fit - 0.5 * (prior * beta**2).sum())

    beta, value = start, objective(start)
    for _ in range(num_steps):
        probability = expit(rows @ beta)
        gradient = rows.T @ (agrees - probability) - prior * beta
        weight = probability * (1 - probability)
        hessian = (rows.T * weight) @ rows + np.diag(prior)
        step = np.linalg.solve(hessian, gradient)
        gain, length = float(gradient @ step), 1.0
        if gain < 1e-6:
            break
        while length > 1e-4:
            new = objective(beta + length * step)
            if new > value + 0.1 * length * gain:
                break
            length *= 0.5
        beta, value = beta + length * step, new
    log_det = np.linalg.slogdet(hessian)[1]
    return beta, value - float(np.log(scale).sum()) - 0.5 * float(log_det)
