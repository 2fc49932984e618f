r"""The posterior of a linear model whose errors are unknown and whose effects doubtful.

.. math::
    p(u \mid x) \propto \sum_s P(s) \sum_j w_j\, Z_{sj}\,
    \mathcal N(u;\, m_{sj}, \Sigma_{sj})\, [\text{low} \le u \le \text{high}]

over sets s of effects that are there and draws j of all channels' errors
(:class:`ChannelErrors`). An effect is absent, its part of u zero, unless it is there:
what may be missing widens the intervals by as much as the logs leave it open, and
hardly where they exclude it. Sets are as probable as in a verdict, and looked at from
none on, beside those that are near the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.linear.left_out import bounded
from sbi_active.criticism.linear.mixture import integrated
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import Grams, Processes
from sbi_active.criticism.results import NONE
from sbi_active.criticism.rivals.error_models import drawn
from sbi_active.criticism.steps.detection import log_prior, log_priors
from sbi_active.inference.sampling.mixtures import draws_between
from sbi_active.inference.sampling.weights import log_sum_exp, normalized, systematic

TINY = 1e-300  # keeps logarithms finite


@dataclass(frozen=True)
class ChannelErrors:
    r"""What rows say of the errors of each channel, of an unknown shape and size.

    .. math::
        r_c(u) \sim \mathcal N(0, v_c\, C_{h_c})

    Several channels have too many combinations to sum over. Given u, channels
    are independent, so that errors are drawn by what the residuals at some likely u say
    of each channel,

    .. math::
        q(h, v) = \frac1P \sum_p \prod_c p(h_c, v_c \mid r_c(u_p)),

    and a linear model is summed over the draws, with the weights :math:`p(h, v) / q(h,
    v)`, as it is over a grid.

    Attributes:
        processes: Hypotheses of the errors, white noise first, of size one.
        grams: Gram matrices of a linear model's rows, by channel.
        known: Deviation of the white part of each channel, shape (c,); None if it is
            unknown, and as likely on any scale.
        white: Prior probability that a channel's errors are white, one half for want of
            anything better.
    """

    processes: Processes
    grams: Grams
    known: Array | None
    white: float = 0.5

    @cached_property
    def _log_prior(self) -> Array:
        """Log prior probability of each hypothesis, shape (h,)."""
        num = len(self.processes)
        rest = np.full(num - 1, (1 - self.white) / max(num - 1, 1))
        return np.log(np.append(self.white, rest))

    def _said(self, u: Array) -> tuple[Array, Array]:
        """Return log probabilities of hypotheses, and squares, both (p, c, h).

        Args:
            u: Places, counted from where the rows are, shape (p, d).
        """
        one = np.concatenate([np.ones((len(u), 1)), -u], 1)
        square = np.einsum("pi,hcij,pj->pch", one, self.grams.gram, one, optimize=True)
        square, count = np.maximum(square, TINY), self.grams.count[:, None]
        if self.known is None:  # with the variance summed out, p(v) = 1 / v
            log_p = -0.5 * count * np.log(square)
        else:
            every = self._every
            log_p = -0.5 * (square / every + count * np.log(every))
        log_p = log_p + self._log_prior - 0.5 * self.grams.log_det.T
        return log_p - log_sum_exp(log_p, axis=2)[..., None], square

    @property
    def _every(self) -> Array:
        """Variance of each hypothesis where the white part is known, shape (c, h)."""
        assert self.known is not None
        return self.known[:, None] ** 2 / self.processes.white

    def likeliest(self, u: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the likeliest hypothesis and variance of each channel, (c,), at u."""
        log_p, square = self._said(u[None])
        shape, channel = log_p[0].argmax(1), np.arange(log_p.shape[1])
        if self.known is not None:
            return shape, self._every[channel, shape]
        return shape, square[0, channel, shape] / self.grams.count

    def places(
        self,
        model: LinearModel,
        free: NDArray[np.bool_],
        num: int,
        rng: np.random.Generator,
        *,
        rounds: int = 6,
    ) -> Array:
        """Return draws of the coordinates where errors are likeliest, (num, d).

        Args:
            model: Linear model of the rows, which counts from where they are.
            free: Coordinates that are not zero, shape (d,).
            num: Number of draws.
            rng: Source of the draws.
            rounds: Times that errors and coordinates are found given the other. A place
                that is not final costs draws of the errors, and no more.
        """
        u, cov, weight = np.zeros(len(free)), np.zeros((len(free),) * 2), model.sd**-2
        at, ends = np.ix_(free, free), (model.low[free], model.high[free])
        for _ in range(rounds):
            shape, variance = self.likeliest(u)
            gram = self._gram(shape[None], variance[None])[0]
            precision = (gram[1:, 1:] + np.diag(weight))[at]
            right = (gram[1:, 0] + model.center * weight)[free]
            u[free] = bounded(precision[None], right[None], *ends)[0]
            cov[at] = np.linalg.inv(precision)
        return model.draws(u, cov, num, rng)

    def drawn(
        self, u: Array, num: int, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return draws of all channels' errors by the residuals at some places.

        Args:
            u: Places, shape (p, d).
            num: Number of draws.
            rng: Source of the draws.

        Returns:
            Gram matrices of all rows in the metric of each draw, (num, k, k); log prior
            densities, with the constants of the likelihood, over the density of the
            draws, (num,).
        """
        log_p, square = self._said(u)
        channel, half = np.arange(log_p.shape[1]), 0.5 * self.grams.count
        place = np.arange(num) % len(u)
        (shape,) = drawn(log_p[place].reshape(-1, log_p.shape[2]), rng)
        shape = shape.reshape(num, -1)
        log_q = log_p[:, channel, shape]
        if self.known is None:
            own = 0.5 * square[:, channel, shape]
            variance = own[place, np.arange(num)] / rng.gamma(half, size=shape.shape)
            rate = own / variance
            log_q = log_q + half * np.log(rate) - rate - gammaln(half)
        else:
            variance = self._every[channel, shape]
        log_p = self._log_prior[shape] - half * np.log(variance)
        log_p = log_p - 0.5 * self.grams.log_det[shape, channel]
        log_q = log_sum_exp(log_q.sum(2), axis=0) - np.log(len(u))
        return self._gram(shape, variance), log_p.sum(1) - log_q

    def _gram(self, shape: NDArray[np.intp], variance: Array) -> Array:
        """Return the Gram matrix of all rows given the errors, shape (n, k, k)."""
        own = self.grams.gram[shape, np.arange(shape.shape[1])]
        return (own / variance[..., None, None]).sum(1)


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
