r"""The posterior of a linear model whose errors are unknown and whose effects doubtful.

.. math::
    p(u \mid x) \propto \sum_s P(s) \sum_j w_j\, Z_{sj}\,
    \mathcal N(u;\, m_{sj}, \Sigma_{sj})\, [\text{low} \le u \le \text{high}]

over sets s of effects that are there and draws j of all channels' errors
(:mod:`.channels`). An effect is absent, its part of u zero, unless it is there: what
may be missing widens the intervals by as much as the logs leave it open, and hardly
where they exclude it. Sets are as probable as in a verdict, and looked at from none on,
beside those that are near the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.linear.mixture import integrated
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.results import NONE
from sbi_active.criticism.steps.detection import log_prior, log_priors
from sbi_active.inference.sampling.mixtures import draws_between
from sbi_active.inference.sampling.weights import log_sum_exp, normalized, systematic

EffectSet = frozenset[int]


class Draws(NamedTuple):
    """Draws of the posterior.

    Attributes:
        u: Coordinates, shape (n, d).
        present: Whether each effect is there, bool, shape (n, e).
    """

    u: Array
    present: NDArray[np.bool_]


class Component(NamedTuple):
    """A set of effects, given each draw of the errors.

    Attributes:
        log_p: Log probability, unnormalized, shape (j,).
        mean: Means of the coordinates that are free, shape (j, k).
        cov: Their covariances, shape (j, k, k).
    """

    log_p: Array
    mean: Array
    cov: Array


@dataclass(frozen=True)
class Posterior:
    """Posterior of a linear model, summed over sets of effects and errors.

    Attributes:
        model: Linear model with all effects, which counts from where they vanish.
        effects: The effects.
        effect: Number of the effect that a coordinate belongs to, -1 for none, (d,).
        gram: Gram matrix of its rows given each draw of the errors, shape (j, k, k).
        log_weight: Log weight of each of these draws, shape (j,).
        near: Nats behind the best set up to which a set's neighbors are looked at, with
            an effect more or less.
        sets: Sets of effects that were looked at.
    """

    model: LinearModel
    effects: Sequence[Effect]
    effect: NDArray[np.int64]
    gram: Array
    log_weight: Array
    near: float
    sets: dict[EffectSet, Component] = field(default_factory=dict)

    def __post_init__(self) -> None:
        log_p: dict[EffectSet, float] = {}
        new = {EffectSet()}
        done: set[EffectSet] = set()
        while new:
            best = max(new, key=lambda known: log_p.get(known, 0.0))
            done.add(best)
            beside = (best ^ {e} for e in range(len(self.effects)))
            for one in {best, *beside} - log_p.keys():
                self.sets[one] = self._component(one)
                log_p[one] = float(log_sum_exp(self.sets[one].log_p))
            least = max(log_p.values()) - self.near
            new = {one for one, value in log_p.items() if value > least} - done

    def free(self, present: EffectSet) -> NDArray[np.bool_]:
        """Return the coordinates that are not zero, (d,), by the effects present."""
        return np.isin(self.effect, [-1, *present])

    def _component(self, present: EffectSet) -> Component:
        """Return a set of effects with its evidence, given each draw of the errors."""
        free, prior = self.free(present), log_priors(self.effects)
        at = np.flatnonzero(np.append(True, free))
        gram = self.gram[:, at[:, None], at]
        log_z, mean, cov = integrated(gram, self.model.part(free), (1.0,))
        names = tuple(self.effects[e].name for e in sorted(present))
        log_p = log_prior(names, prior) if names else prior[NONE]
        return Component(self.log_weight + log_z[:, 0] + log_p, mean[:, 0], cov[:, 0])

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
        place = systematic(share, num, float(rng.random()))
        which, error = np.unravel_index(place, log_p.shape)
        u, log_w = np.zeros((num, len(model.u))), np.zeros(num)
        present = np.zeros((num, len(self.effects)), dtype=bool)
        for s, (one, own) in enumerate(self.sets.items()):
            at, free = np.flatnonzero(which == s), self.free(one)
            given = own.mean[error[at]], own.cov[error[at]]
            drawn = draws_between(*given, model.low[free], model.high[free], rng)
            u[np.ix_(at, free)], log_w[at] = drawn
            present[at[:, None], [*one]] = True
        kept = systematic(normalized(log_w), num, float(rng.random()))
        return Draws(u[kept], present[kept])
