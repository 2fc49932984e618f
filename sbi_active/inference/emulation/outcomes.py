r"""What a trial's outcome tells by being a measurement, or none.

A trial that fell off the table has no number to regress, yet where in parameter space
trials fall off is information. The likelihood of a trial is that of what happened,

.. math::
    p(x_k | \theta) = \begin{cases}
    P(\text{invalid} | \theta) & \text{without a measurement}, \\
    P(F_k | \theta)\, p(x_{F_k} | \theta, F_k) & \text{with the numbers } F_k,
    \end{cases}

where :math:`F_k` stands for "these numbers, and perhaps others, are present". What the
absence of others tells beyond that is left out: the posterior is of a part of the
data, so it can be wider than it could be but is not biased.

The probabilities are logistic regressions in a region's coordinates,

.. math::
    P(y = 1 | u) = \epsilon + (1 - 2 \epsilon)\, \sigma(\beta^\top f(u)), \qquad
    \beta \sim \mathcal N(0, \tau^2 I),

whose degree and :math:`\tau` have the largest evidence: a chance that varies smoothly
gets a small :math:`\tau`, and a hard edge, :math:`y = 1\{g(u) > 0\}`, as steep a slope
as the simulations on its two sides allow.

References:
    MacKay, Neural Computation 1992 (evidence of a classifier, by Laplace's method).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit

from sbi_active.arrays import Array
from sbi_active.inference.emulation.solving import Region
from sbi_active.inference.engine.surface import features


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
