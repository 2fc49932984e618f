"""Nuisances of trials that were not fitted, given the first part of each.

An estimator on the robot would do the same: from the first samples of a new trial it
finds where the trial starts, and predicts the rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator


def conditioned(
    rivals: RivalSet,
    fit: Fit,
    u: Array,
    simulator: TrialSimulator,
    rng: np.random.Generator,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return theta and phi with nuisances drawn given the first part of each trial.

    They are solved for within each trial at the mean of the draws, linearized there,
    and drawn for each: their posterior is Gaussian given the draw.

    Args:
        rivals: The models, which say how long the first part is.
        fit: Fit of the model.
        u: Draws of its coordinates, shape (n, dim).
        simulator: Simulator of the trials that were not fitted.
        rng: Source of the draws.
    """
    m = simulator.measurements
    center, spread = rivals.prior_predictive(simulator)
    error = rivals.noise_of(m)
    given = {"error": error, "spread": spread, "center": center}
    rival = replace(fit.rival, simulator=simulator, **given)
    own = fit.rival.residual(u.mean(0, keepdims=True))[0][0]
    size = np.sqrt(np.mean((own / rivals.noise.typical_sd) ** 2))
    unit = error.typical_sd * max(size, 1e-3)
    c, first = rival.coordinates, is_first_part(m, rivals.warm_up)
    num_own = c.num_own
    z = np.zeros((len(u), c.dim))
    z[:, :num_own] = fit.rival.coordinates.to_z(u)[:, :num_own]
    draws = c.from_z(z)
    draws[:, num_own:] = c.center[num_own:]
    point = draws.mean(0, keepdims=True)

    def whiten(residual: Array) -> Array:
        return residual / unit

    blocks = [
        (np.flatnonzero(c.trial_of() == t), np.flatnonzero(first & (m.trial == t)))
        for t in range(len(simulator))
    ]
    gains: list[tuple[Array, Array]] = []
    for _ in range(4):  # Gauss-Newton steps
        r, jacobian = rival.jacobian(point, whiten, rivals.step)
        gains = [_gain(jacobian[0], c.precision, *block) for block in blocks]
        _correct(point, r, c.center, c.precision, blocks, gains)
        point = np.clip(point, c.low, c.high)
    draws[:, num_own:] = point[:, num_own:]
    r = whiten(rival.residual(draws)[0])
    _correct(draws, r, c.center, c.precision, blocks, gains)
    for (columns, _), (_, cov) in zip(blocks, gains, strict=True):
        factor = np.linalg.cholesky(cov)
        draws[:, columns] += rng.normal(size=(len(u), len(columns))) @ factor.T
    return c.split(np.clip(draws, c.low, c.high))


def is_first_part(m: Measurements, warm_up: float) -> NDArray[np.bool_]:
    """Return a mask of numbers within a time of their trial's first, shape (N,)."""
    begin = np.full(m.shape[0], np.inf)
    np.minimum.at(begin, m.trial, m.time)
    return m.time - begin[m.trial] < warm_up


def _gain(
    jacobian: Array, precision: Array, columns: Array, rows: Array
) -> tuple[Array, Array]:
    """Return the response of nuisances to the first part's residual, and their cov."""
    part = jacobian[np.ix_(rows, columns)]
    prior = np.diag(np.maximum(precision[columns], 1e-6))
    cov = np.linalg.inv(part.T @ part + prior)
    return cov @ part.T, cov


def _correct(
    u: Array,
    residual: Array,
    center: Array,
    precision: Array,
    blocks: list[tuple[Array, Array]],
    gains: list[tuple[Array, Array]],
) -> None:
    """Take a Gauss-Newton step of each trial's nuisances, in place."""
    for (columns, rows), (gain, cov) in zip(blocks, gains, strict=True):
        pull = (u[:, columns] - center[columns]) * precision[columns]
        u[:, columns] -= residual[:, rows] @ gain.T + pull @ cov
