r"""The posterior of a linear model whose errors are unknown and whose effects doubtful.

.. math::
    p(u \mid x) \propto \sum_s P(s) \sum_j w_j\, Z_{sj}\,
    \mathcal N(u;\, m_{sj}, \Sigma_{sj})\, [\text{low} \le u \le \text{high}]

over sets s of effects that are there and draws j of all channels' errors
(:mod:`.channels`). An effect is absent, its part of u zero, unless it is there: what
may be missing widens the intervals by as much as the logs leave it open, and hardly
where they exclude it. Sets are enumerated from none on, beside those that are near the
best.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.identification.channels import ErrorDraws
from sbi_active.criticism.linear.mixture import integrated
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.inference.sampling.truncated import draws_between
from sbi_active.inference.sampling.weights import (
    log_sum_exp,
    normalized,
    systematic,
)

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Draws:
    """Draws of the posterior.

    Attributes:
        u: Coordinates, shape (n, d).
        present: Whether each effect is there, bool, shape (n, e).
        errors: Hypothesis of each channel, shape (n, c).
        size: Deviation of each channel's errors, shape (n, c).
    """

    u: Array
    present: Flags
    errors: NDArray[np.intp]
    size: Array


@dataclass(frozen=True)
class Component:
    """A set of effects, given each draw of the errors.

    Attributes:
        present: Whether each effect is there, shape (e,).
        log_p: Log probability, unnormalized, shape (j,).
        mean: Means of the coordinates that are free, shape (j, k).
        cov: Their covariances, shape (j, k, k).
    """

    present: Flags
    log_p: Array
    mean: Array
    cov: Array


@dataclass(frozen=True)
class Posterior:
    """Posterior of a linear model, summed over sets of effects and errors.

    Attributes:
        model: Linear model with all effects, which counts from where they vanish.
        effect: Number of the effect that a coordinate belongs to, -1 for none, (d,).
        errors: Draws of the errors.
        absent: Prior probability that no effect is there.
        near: Nats behind the best set up to which a set's neighbors are looked at, with
            an effect more or less.
        sets: Sets of effects that were looked at.
    """

    model: LinearModel
    effect: NDArray[np.int64]
    errors: ErrorDraws
    absent: float
    near: float
    sets: dict[bytes, Component] = field(default_factory=dict)

    def __post_init__(self) -> None:
        num = int(self.effect.max(initial=-1)) + 1
        done: set[bytes] = set()
        total = {self._look(np.zeros(num, dtype=bool))[0]: np.inf}
        while total:
            best = max(total, key=total.__getitem__)
            done.add(best)
            present = self.sets[best].present
            for e in range(num):
                other = present.copy()
                other[e] ^= True
                if other.tobytes() not in self.sets:
                    self._look(other)
            every = {k: float(log_sum_exp(s.log_p)) for k, s in self.sets.items()}
            least = max(every.values()) - self.near
            total = {k: v for k, v in every.items() if v > least and k not in done}

    def free(self, present: Flags) -> Flags:
        """Return the coordinates that are not zero, (..., d), by present effects."""
        every = np.ones((*present.shape[:-1], 1), dtype=bool)
        return np.concatenate([present, every], -1)[..., self.effect]

    def _look(self, present: Flags) -> tuple[bytes, Component]:
        """Record a set of effects with its evidence, given each draw of the errors."""
        free, num = self.free(present), len(present)
        at = np.flatnonzero(np.append(True, free))
        gram = self.errors.gram[:, at[:, None], at]
        log_z, mean, cov = integrated(gram, self.model.part(free), (1.0,))
        none = np.log(self.absent) / max(num, 1)  # of one effect
        there = present.sum()
        log_prior = there * np.log(-np.expm1(none)) + (num - there) * none
        log_p = self.errors.log_weight + log_z[:, 0] + log_prior
        key = present.tobytes()
        self.sets[key] = Component(present, log_p, mean[:, 0], cov[:, 0])
        return key, self.sets[key]

    @property
    def log_p(self) -> Array:
        """Log probability of each set and each draw of the errors, shape (s, j)."""
        return np.stack([own.log_p for own in self.sets.values()])

    def draws(self, num: int, rng: np.random.Generator) -> Draws:
        """Return draws of the posterior.

        Args:
            num: Number of draws.
            rng: Source of the draws.
        """
        model, log_p = self.model, self.log_p
        share = normalized(log_p.ravel())
        flat = systematic(share, num, float(rng.random()))
        which, error = np.unravel_index(flat, log_p.shape)
        u, log_w = np.zeros((num, len(model.u))), np.zeros(num)
        sets = [*self.sets.values()]
        for s in np.unique(which):
            own, at = sets[s], np.flatnonzero(which == s)
            free = self.free(own.present)
            given = own.mean[error[at]], own.cov[error[at]]
            drawn = draws_between(*given, model.low[free], model.high[free], rng)
            u[np.ix_(at, free)], log_w[at] = drawn
        kept = systematic(normalized(log_w), num, float(rng.random()))
        present = np.stack([own.present for own in sets])[which[kept]]
        errors, size = self.errors.shape, np.sqrt(self.errors.variance)
        return Draws(u[kept], present, errors[error[kept]], size[error[kept]])
