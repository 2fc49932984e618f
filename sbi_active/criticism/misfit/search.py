"""Fits of the bare model and of sets of effects, found by linear evidence.

Only sets that linear evidence puts near the front are fitted: all single effects, the
pairs that look best beside the bare model or beside one of the best single effects, and
larger sets grown from the best smaller ones. What a fit costs is some hundred
simulations of the trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.misfit.left_out import LeftOut, leave_out
from sbi_active.criticism.misfit.linear import LinearModel, enlarged, linearize
from sbi_active.criticism.misfit.processes import Errors, Grams, Posterior
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Draws of the prior that are screened for the bare model, and starts of its search.
NUM_SCREENED, NUM_STARTS, NUM_KEPT = 128, 12, 4
#: Draws of a further effect from which its fit starts, beside one near the null.
NUM_DRAWN = 3
#: Draws of the prior that are screened, and kept, for a set with an effect that no
#: number makes vanish: parameters beside it lie far from those without it.
NUM_FAR, NUM_KEPT_FAR = 32, 6
#: Deviations of its prior by which a further effect is tried, and the share of them
#: that hardly acts.
TRIED, FAINT = 0.3, 0.03
#: Iterations that follow a secant, and full ones; rounds of the latter at most.
SECANT, FULL, ROUNDS = 5, 5, 3
#: A fall of the sum of squares that is worth another round, in units of the residual's
#: own variance.
WORTH = 1.0
#: Sets from which larger ones are looked for, and larger ones that are fitted.
NUM_BASES, NUM_PAIRS, NUM_LARGER = 3, 10, 3
MAX_EFFECTS = 4


@dataclass
class Candidate:
    """A model that was fitted.

    Attributes:
        model: Linearized at its best fit.
        grams: Of its rows.
        posterior: Under the shared errors.
        left: Its errors on left-out parts of the trials.
        log_prior: Probability of its set of effects, nats.
    """

    model: LinearModel
    grams: Grams
    posterior: Posterior
    left: LeftOut
    log_prior: float

    @property
    def log_p(self) -> float:
        """Unnormalized log posterior probability with a residual process, nats."""
        return self.log_prior + self.posterior.log_process


@dataclass
class Search:
    """Fits models and keeps them.

    Args:
        rivals: The models and the trials; smooth, with a time axis.
        unit: Standard deviation of the sensor, shape (N,).
        prior: Log prior probabilities of "none" and each effect.
        cells: The sensor's error alone.

    Attributes:
        found: Fitted models, the bare one first.
        errors: That all models share; known after the bare fit.
        names: Effects that change the prediction.
    """

    rivals: RivalSet
    unit: Array
    prior: dict[str, float]
    cells: list[NoiseCell]
    found: dict[ModelKey, Candidate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        effects = self.rivals.effects.values()
        self.names = [e.name for e in effects if e.hook != "noise"]
        self._rivals: dict[ModelKey, Rival] = {}
        self._seed = derive_seed(self.rivals.seed, "misfit")
        bare = self._fit_bare()
        self.errors = Errors(
            self.rivals.measurements,
            self.unit,
            self.cells,
            largest=bare.rms,
            warm_up=self.rivals.warm_up if self.rivals.nuisances else 0.0,
            varying=bare.jacobian[:, bare.trial_of < 0],
        )
        self.keep(bare)

    def keep(self, model: LinearModel) -> Candidate:
        """Record a fitted model with its evidence."""
        grams = self.errors.grams(model.rows)
        posterior = self.errors.posterior(model, grams)
        names = model.key.effects
        prior = log_prior(names, self.prior) if names else self.prior["none"]
        left = leave_out(model, self.errors)
        self.found[model.key] = Candidate(model, grams, posterior, left, prior)
        return self.found[model.key]

    def fit_singles(self) -> None:
        """Fit every effect alone, and the bare model again from where they end."""
        for name in self.names:
            self.keep(self._fit(ModelKey((name,)), [ModelKey()]))
        best = self._best(1)
        bare = self.found[ModelKey()].model
        starts = [self.found[key].model.u[self._shared(key)] for key in best]
        again = self._settle(ModelKey(), np.array([bare.u, *starts]))
        if again.rms < bare.rms:
            self.keep(again)

    def fit_larger(self) -> None:
        """Fit the sets of several effects that linear evidence puts in front."""
        for size in range(2, min(MAX_EFFECTS, len(self.names)) + 1):
            bases = self._best(size - 1)
            if size == 2:
                bases = [ModelKey(), *bases]
            scores = self._scores(bases, size)
            most = NUM_PAIRS if size == 2 else NUM_LARGER
            best = sorted(scores, key=scores.__getitem__)[::-1][:most]
            for key in dict.fromkeys([*best, *self._sampled(size)]):
                self.fit_set(key)
            before = max(self.found[k].log_p for k in bases if k.effects or size == 2)
            new = [c.log_p for k, c in self.found.items() if len(k.effects) == size]
            if not new or max(new) < before:
                break

    def _sampled(self, size: int) -> list[ModelKey]:
        """Return the sets that sampled evidence puts in front, where there is any."""
        fits = self.rivals.fits
        keys = [k for k in fits if len(k.effects) == size and k.error is None]
        keys = [k for k in keys if {*k.effects} <= {*self.names}]
        return sorted(keys, key=lambda k: -fits[k].evidence.log_evidence)[:NUM_BASES]

    def fit_set(self, key: ModelKey) -> Candidate:
        """Fit one set of effects from its parts, once."""
        if key not in self.found:
            known = [p for p in key.parts if p in self.found]
            # Of a set that sampling found, its effects alone may be what was fitted.
            alone = [ModelKey((name,)) for name in key.effects]
            self.keep(self._fit(key, known or alone))
        return self.found[key]

    def likeliest(self) -> str | None:
        """Return the effect that alone is likeliest given the sensor's error."""

        def log_p(name: str) -> float:
            found = self.found[ModelKey((name,))]
            return found.log_prior + found.posterior.log_sensor

        return max(self.names, key=log_p, default=None)

    def _best(self, size: int) -> list[ModelKey]:
        """Return the sets to add to: the likeliest, and those that fit best.

        Evidence along an autocorrelated error is for what is fast; what leaves the
        smallest residual may be slow, and half of what is missing.
        """
        keys = [k for k in self.found if len(k.effects) == size]
        likeliest = sorted(keys, key=lambda k: -self.found[k].log_p)[:NUM_BASES]
        closest = sorted(keys, key=lambda k: self.found[k].model.rms)[:NUM_BASES]
        return [*dict.fromkeys([*likeliest, *closest])]

    def _rival(self, key: ModelKey) -> Rival:
        if key not in self._rivals:
            self._rivals[key] = self.rivals.rival(key)
        return self._rivals[key]

    def _shared(self, key: ModelKey) -> NDArray[np.bool_]:
        """Return the coordinates of a model that the bare one has."""
        return self.columns(key, ModelKey())

    def columns(self, key: ModelKey, part: ModelKey) -> NDArray[np.bool_]:
        """Return the coordinates of a model that one with fewer effects has."""
        rival = self._rival(key)
        keep = np.ones(rival.dim, dtype=bool)
        for name in {*key.effects} - {*part.effects}:
            keep[rival.columns()[name]] = False
        return keep

    # The fits.

    def _fit_bare(self) -> LinearModel:
        rival, key = self._rival(ModelKey()), ModelKey()
        c = rival.coordinates
        u = c.sample(NUM_SCREENED, seed=self._seed)
        r = rival.residual(u)[0] / self.unit
        order = np.argsort((r**2).sum(1))
        half = NUM_STARTS // 2
        u = np.concatenate([u[order[:half]], u[order[half::7]][:half]])
        scale = max(float(np.sqrt(np.mean(r[order[0]] ** 2))), 1.0)
        u, cost = self._descend(rival, u, scale, 2 * SECANT, secant=True)
        return self._settle(key, u[np.argsort(cost)[:NUM_KEPT]])

    def _fit(self, key: ModelKey, parents: Sequence[ModelKey]) -> LinearModel:
        """Fit a set of effects from fits of smaller ones."""
        rival = self._rival(key)
        drawn = rival.coordinates.sample(
            NUM_DRAWN, seed=derive_seed(self._seed, str(key))
        )
        starts, columns = [], rival.columns()
        for parent in parents:
            model, own = self.found[parent].model, self._rival(parent)
            new = {*key.effects} - {*parent.effects}
            # What acts nowhere at the end of its prior has no slope to follow there.
            is_far = not parent.effects or not all(map(self._has_null, new))
            for k in range(-1, NUM_DRAWN if is_far else 0):
                u = drawn[max(k, 0)].copy()
                rest = np.ones(rival.dim, dtype=bool)
                for name in key.effects:
                    place = columns[name]
                    rest[place] = False
                    if name in parent.effects:
                        u[place] = model.u[own.columns()[name]]
                    elif k < 0:
                        u[place] = self._near_null(name)
                u[rest] = model.u[self._shared(parent)]
                starts.append(u)
        if key in self.rivals.fits:  # what is flat at its null was found by sampling
            starts.append(self.rivals.fits[key].likeliest[0])
        if not all(map(self._has_null, key.effects)):
            starts += [*self._screened(key)]
        c = rival.coordinates
        u = np.clip(np.array(starts), c.low, c.high)
        scale = max(min(self.found[p].model.rms for p in parents), 1.0)
        u, cost = self._descend(rival, u, scale, SECANT, secant=True)
        found = self._settle(key, u[np.argsort(cost)[:2]])
        best = min(parents, key=lambda p: self.found[p].model.rms)
        if found.rms > self.found[best].model.rms:
            again = self._settle(key, self._faint(key, best)[None])
            found = again if again.rms < found.rms else found
        return found

    def _faint(self, key: ModelKey, parent: ModelKey) -> Array:
        """Return a fit with further effects that hardly act, shape (d,).

        A set fits no worse than its part. Where it seems to, its fit was lost where an
        effect as strong as its prior holds the machine still, or throws it about.
        """
        rival, model = self._rival(key), self.found[parent].model
        u, columns = np.empty(rival.dim), rival.columns()
        u[self.columns(key, parent)] = model.u
        for name in {*key.effects} - {*parent.effects}:
            null, step = self._null(name)
            u[columns[name]] = null + FAINT * step
        return u

    def _screened(self, key: ModelKey) -> Array:
        """Return the draws of a set's prior that are nearest to the trials, (n, d)."""
        rival = self._rival(key)
        seed = derive_seed(self._seed, str(key), "screened")
        u = rival.coordinates.sample(NUM_FAR, seed=seed)
        square = ((rival.residual(u)[0] / self.unit) ** 2).sum(1)
        return u[np.argsort(square)[:NUM_KEPT_FAR]]

    def _settle(self, key: ModelKey, u: Array) -> LinearModel:
        """Return a model linearized at the best fit from some starts."""
        rival = self._rival(key)
        r = rival.residual(u)[0] / self.unit
        square = (r**2).mean(1)
        for _ in range(ROUNDS):
            scale = max(float(np.sqrt(square.min())), 1.0)
            u, _ = self._descend(rival, u, scale, FULL)
            r = rival.residual(u)[0] / self.unit
            before, square = square.min(), (r**2).mean(1)
            order = np.argsort(square)[:2]
            u, square = u[order], square[order]
            if (before - square[0]) * r.shape[1] < WORTH * max(square[0], 1.0):
                break
        return linearize(rival, u[0], self.unit, self.rivals.step)

    def _descend(
        self, rival: Rival, u: Array, scale: float, iterations: int, **options: Any
    ) -> tuple[Array, Array]:
        unit = self.unit * scale
        return descend(
            rival, u, lambda r: r / unit, self.rivals.step, iterations, **options
        )

    # Which larger sets are worth a fit.

    def _scores(self, bases: Sequence[ModelKey], size: int) -> dict[ModelKey, float]:
        """Return the largest linear log posterior of each set, over the bases."""
        scores: dict[ModelKey, float] = {}
        for base in bases:
            rest = [n for n in self.names if n not in base.effects]
            columns = {n: self._column(base, n) for n in rest}
            for new in combinations(rest, size - len(base.effects)):
                names = tuple(n for n in self.names if n in (*base.effects, *new))
                key = ModelKey(names)
                if key in self.found:
                    continue
                rival = self._rival(key)
                place = rival.columns()
                changes = []
                for name in new:
                    at = np.arange(rival.dim)[place[name]]
                    value, column = columns[name]
                    changes.append((np.stack([at, value]), column))
                model = enlarged(self.found[base].model, rival, changes)
                grams = self.errors.grams(model.rows)
                posterior = self.errors.posterior(model, grams)
                value = posterior.log_process + log_prior(names, self.prior)
                scores[key] = max(value, scores.get(key, -np.inf))
        return scores

    def beside(
        self, base: ModelKey, name: str
    ) -> tuple[LinearModel, NDArray[np.bool_]]:
        """Return a model with a further effect where it vanishes, and its columns."""
        key = ModelKey(tuple(n for n in self.names if n in (*base.effects, name)))
        rival = self._rival(key)
        at = np.arange(rival.dim)[rival.columns()[name]]
        value, column = self._column(base, name)
        change = np.stack([at, value]), column
        own = np.isin(np.arange(rival.dim), at)
        return enlarged(self.found[base].model, rival, [change]), own

    def rms(self, key: ModelKey, u: Array) -> float:
        """Return the rms residual of a model anywhere, in sensor deviations."""
        r = self._rival(key).residual(u[None])[0] / self.unit
        return float(np.sqrt(np.mean(r**2)))

    def _column(self, base: ModelKey, name: str) -> tuple[Array, Array]:
        """Return phi near its null, and what a change of it does beside a model.

        A chord and no tangent: many effects are flat at their null.
        """
        key = ModelKey(tuple(n for n in self.names if n in (*base.effects, name)))
        rival, model = self._rival(key), self.found[base].model
        place, columns = rival.columns(), self._rival(base).columns()
        at_null, step = self._null(name)
        start = np.empty(rival.dim)
        rest = np.ones(rival.dim, dtype=bool)
        for other in key.effects:
            rest[place[other]] = False
            if other != name:
                start[place[other]] = model.u[columns[other]]
        start[rest] = model.u[self._shared(base)]
        start[place[name]] = at_null
        where = np.arange(rival.dim)[place[name]]
        points = np.repeat(start[None], len(where), 0)
        points[np.arange(len(where)), where] += step
        r = rival.residual(points)[0] / self.unit
        return at_null, ((r - model.residual) / step[:, None]).T

    def _null(self, name: str) -> tuple[Array, Array]:
        """Return the null of an effect among the coordinates, and a step from it."""
        rival = self._rival(ModelKey((name,)))
        c, place = rival.coordinates, rival.columns()[name]
        effect = self.rivals.effects[name]
        null = effect.null_phi(1).double().numpy()
        z = c.to_z(np.clip(np.zeros((1, rival.dim)), c.low, c.high))
        low, high = c.low[place], c.high[place]
        if np.isfinite(null).all():
            z[:, place] = null
            u = c.from_z(z)[0, place]
        else:  # the end of the prior that is nearest to it
            u = np.where(null[0] > 0, high, low)
        step = np.where(u + TRIED > high, -TRIED, TRIED)
        return np.clip(u, low, high), step

    def _has_null(self, name: str) -> bool:
        return bool(self.rivals.effects[name].null_phi(1).isfinite().all())

    def _near_null(self, name: str) -> Array:
        null, step = self._null(name)
        return null + step
