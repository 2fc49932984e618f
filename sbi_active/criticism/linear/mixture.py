"""The posterior of a linear model, summed over hypotheses of the errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.linear.model import LinearModel, touching
from sbi_active.inference.sampling.mixtures import log_inside
from sbi_active.inference.sampling.weights import log_sum_exp

#: Factors on the scale of an effect's prior, equally likely.
WIDTHS = (1 / 3, 1.0, 3.0)


@dataclass(frozen=True)
class Mixture:
    """A linear model's posterior, summed over hypotheses of the errors.

    Attributes:
        log_evidence: Log evidence, nats.
        mean: Mean of u, shape (d,).
        cov: Covariance of u, shape (d, d).
        log_z: Log evidence of each hypothesis times its prior probability, by factor
            on the scale of effects' priors, shape (h, w).
    """

    log_evidence: float
    mean: Array
    cov: Array
    log_z: Array

    @property
    def share(self) -> Array:
        """Posterior probability of each hypothesis, shape (h,)."""
        return np.exp(self.log_z - self.log_evidence).sum(1)


def either(one: Mixture, other: Mixture) -> float:
    """Return the log evidence of two errors that are equally likely, nats."""
    return float(np.logaddexp(one.log_evidence, other.log_evidence) - np.log(2))


def summed(gram: Array, log_weight: Array, model: LinearModel) -> Mixture:
    """Return the posterior of a linear model, summed over hypotheses of the errors.

    Args:
        gram: Gram matrices of its rows, shape (h, 1 + d, 1 + d).
        log_weight: Log prior probabilities, with the constants of densities, (h,).
        model: Linear model with its prior; scales of effects' priors are summed out.
    """
    widths = WIDTHS if model.scaled.any() else (1.0,)
    log_z, means, covs = integrated(gram, model, widths)
    log_z = log_z + log_weight[:, None] - np.log(len(widths))
    total = float(log_sum_exp(log_z.ravel()))
    p = np.exp(log_z - total).ravel()
    means = means.reshape(len(p), -1)
    mean = p @ means
    off = means - mean
    cov = np.einsum("h,hij->ij", p, covs.reshape(len(p), *covs.shape[2:]))
    return Mixture(total, mean, cov + (p[:, None] * off).T @ off, log_z)


def beside_process(
    model: LinearModel,
    grams: Callable[[LinearModel], tuple[Array, Array]],
    left: Callable[[LinearModel, Mixture], Array],
    df: float,
    *,
    rounds: int = 6,
) -> LinearModel:
    """Return a model of t errors that they touch where a process beside them leaves.

    A process takes most of what is far out without it. Of Gaussians that touch the
    density of t errors all give a lower bound; that with the largest is taken.

    Args:
        model: Linear model, which they touch without a process.
        grams: Function that gives Gram matrices beside each process, and log weights.
        left: Function from a model and its posterior to what the likeliest process
            leaves of its residuals, shape (N,).
        df: Degrees of freedom.
        rounds: Number of times that they are moved.
    """
    best, largest = model, summed(*grams(model), model).log_evidence
    error = np.zeros(model.num)  # all of it is the process's
    for _ in range(rounds):
        own = touching(model, error, df)
        found = summed(*grams(own), own)
        if found.log_evidence > largest:
            best, largest = own, found.log_evidence
        error = left(own, found) / own.weight
    return best


def integrated(
    gram: Array, model: LinearModel, widths: Sequence[float]
) -> tuple[Array, Array, Array]:
    """Return evidences less their constants, and posterior moments of u.

    Args:
        gram: Gram matrices of its rows, shape (h, 1 + d, 1 + d).
        model: Linear model with its prior.
        widths: Factors w on the scales of effects' priors.

    Returns:
        Shapes (h, w), (h, w, d) and (h, w, d, d).
    """
    sd = np.stack([model.widened(width) for width in widths])
    g, b, rr = gram[:, None, 1:, 1:], gram[:, None, 1:, 0], gram[:, None, 0, 0]
    off, eye = model.center - model.u, np.eye(sd.shape[1])
    precision = sd[:, :, None] * g * sd[:, None] + eye
    # Columns of very different size, as of what jumps, keep their digits in units of
    # their own.
    size = np.sqrt(np.einsum("hwii->hwi", precision))
    own = size[..., None] * size[..., None, :]
    precision = precision / own
    cov = np.linalg.inv(precision) / own
    pull = sd * b + off / sd
    mean = np.einsum("hwij,hwj->hwi", cov, pull)
    log_z = -0.5 * (rr + ((off / sd) ** 2).sum(1) - (pull * mean).sum(2))
    log_det = np.linalg.slogdet(precision)[1] + 2 * np.log(size).sum(2)
    log_z = log_z - 0.5 * log_det  # and from here on about the prior's center
    mean, cov = sd * mean - off, sd[:, :, None] * cov * sd[:, None]
    low, high = model.low - model.center, model.high - model.center
    some = np.isfinite(low) | np.isfinite(high)
    if some.any():
        own = np.sqrt(np.einsum("hwii->hwi", cov))[..., some]
        inside = log_inside(mean[..., some], own, low[some], high[some])
        before = log_inside(np.zeros(some.sum()), sd[:, some], low[some], high[some])
        log_z = log_z + inside.sum(2) - before.sum(1)
    return log_z, mean + model.center, cov
