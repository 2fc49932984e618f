"""Fits that begin where linear evidence puts them, and take a dozen simulations each.

The bare model's derivatives and an effect's column are known from the screening. So a
fit begins with a step to the linear optimum, follows secants, and ends with derivatives
at its own best fit, which its evidence rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.predicted_before import NUM_DRAWS
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.misfit.linear import LinearModel, enlarged, linearize
from sbi_active.criticism.misfit.search import Candidate, Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.screening.library import Library
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Starts of the bare model's search, those of them that go on, and their iterations.
NUM_STARTS, NUM_KEPT, FIRST = 6, 2, 8
#: Steps along secants between two linearizations, and linearizations at most.
SECANT, ROUNDS = 5, 4
#: A fall of the sum of squares that is worth another linearization, in units of the
#: residual's own variance.
WORTH = 0.3
#: Models beside which larger ones are looked for, larger ones that are fitted, and
#: effects of one at most: forces of a dictionary add up to anything.
NUM_BASES, NUM_PAIRS, NUM_LARGER, MAX_EFFECTS = 3, 10, 2, 3
#: Nats by which linear evidence puts a larger model behind one that is fitted, so that
#: it is not fitted.
BEHIND = 10.0
#: Tail probability of a chi-square from which nothing larger than a pair is looked for.
PASSES = 0.01


class FewSimulations(Search):
    """Fits models from their linearizations, and keeps them.

    Attributes:
        library: The bare model with the columns of all effects; known once asked for.
    """

    _library: Library | None = None
    _has_larger = False

    @property
    def library(self) -> Library:
        """The bare model with the columns of all effects."""
        if self._library is None:
            self._library = Library(self)
        return self._library

    def restrict(
        self, names: Sequence[str], every: Sequence[str] | None = None
    ) -> None:
        """Fit models of some effects alone from now on.

        Args:
            names: Theirs.
            every: Of those that they are among; None is of those so far.
        """
        self.names = [n for n in every or self.names if n in names]

    def kin(self, every: Sequence[str]) -> list[str]:
        """Return forms of the family that leaves least, where none explains.

        Args:
            every: Names of all effects.
        """
        effects = self.rivals.effects
        keys = [k for k in self.found if k.effects]
        if self._explains() or not keys:
            return []
        best = min(keys, key=lambda k: self.found[k].model.rms)
        own = effects[best.effects[0]]
        if not is_force(own):
            return []
        same = [n for n in every if effects[n].family == own.family]
        return [n for n in same if ModelKey((n,)) not in self.found]

    def fit_singles(self) -> None:
        """Fit each effect alone, and the bare model from where they end, once."""
        new = [n for n in self.names if ModelKey((n,)) not in self.found]
        if not new:
            return
        for name in new:
            self.fit_set(ModelKey((name,)))
        bare, starts = self.found[ModelKey()].model, []
        for key in self._best(1):
            starts.append(self.found[key].model.u[self._shared(key)])
        rival = self._rival(ModelKey())
        u = np.array(starts)
        square = ((rival.residual(u)[0] / self.unit) ** 2).mean(1)
        if square.min() < 2 * bare.rms**2:
            again = self._polished(rival, u[int(np.argmin(square))])
            if again.rms < bare.rms:
                self.keep(again)

    def fit_larger(self) -> None:
        """Fit the sets of several effects that linear evidence puts in front, once."""
        if self._has_larger:
            return
        self._has_larger = True
        for size in range(2, min(MAX_EFFECTS, len(self.names)) + 1):
            bases = self._best(size - 1)
            if size > 2 and self._explains():
                break
            scores: dict[ModelKey, float] = {}
            for base in [*([ModelKey()] if size == 2 else []), *bases]:
                for key, value in self._beside(base, size).items():
                    scores[key] = max(value, scores.get(key, -np.inf))
            most = NUM_PAIRS if size == 2 else NUM_LARGER
            for key in sorted(scores, key=scores.__getitem__)[::-1][:most]:
                if scores[key] > max(map(_by_either, self.found.values())) - BEHIND:
                    self.fit_set(key)

    def _explains(self) -> bool:
        """Return whether a model leaves no more than the sensor's error."""
        return any(c.model.chi_square[2] >= PASSES for c in self.found.values())

    def _best(self, size: int) -> list[ModelKey]:
        keys = [k for k in self.found if len(k.effects) == size]
        orders = [
            sorted(keys, key=lambda k: -value(self.found[k]))
            for value in (_by_sensor, _by_process, _by_residual)
        ]
        picked = [key for rank in zip(*orders, strict=True) for key in rank]
        return [*dict.fromkeys(picked)][:NUM_BASES]

    def _beside(self, base: ModelKey, size: int) -> dict[ModelKey, float]:
        """Return linear log posteriors of larger sets beside a model."""
        # A free shape beside a form of its kind says nothing, and costs columns.
        if any(map(self._free, base.effects)):
            return {}
        names = [n for n in self.names if n not in base.effects and not self._free(n)]
        library = Library(self, base, names) if base.effects else self.library
        if base.effects:
            library.prepare(names)
        found = {}
        for new in combinations(names, size - len(base.effects)):
            every = {*base.effects, *new}
            key = ModelKey(tuple(n for n in self.names if n in every))
            if key not in self.found:
                found[key] = library.score(new)
        return found

    def _free(self, name: str) -> bool:
        effect = self.rivals.effects[name]
        return is_force(effect) and effect.phi_dim > 1

    # The fits.

    def _fit_bare(self) -> LinearModel:
        rival = self._rival(ModelKey())
        # Those of the prior predictive, which are simulated already.
        seed = derive_seed(self.rivals.seed, "spread")
        u = rival.coordinates.sample(NUM_DRAWS, seed=seed)
        r = rival.residual(u)[0] / self.unit
        order = np.argsort((r**2).sum(1))
        half = NUM_STARTS // 2
        u = np.concatenate([u[order[:half]], u[order[half::NUM_STARTS]][:half]])
        scale = max(float(np.sqrt(np.mean(r[order[0]] ** 2))), 1.0)
        u, cost = self._descend(rival, u, scale, FIRST, secant=True)
        some = [self._polished(rival, p) for p in u[np.argsort(cost)[:NUM_KEPT]]]
        return min(some, key=lambda model: model.rms)

    def _fit(self, key: ModelKey, parents: Sequence[ModelKey]) -> LinearModel:
        """Fit a set of effects from the smaller one that leaves least."""
        rival = self._rival(key)
        if parents:
            base = min(parents, key=lambda parent: self.found[parent].model.rms)
        else:
            base = ModelKey()
        model = self.found[base].model
        for name in key.effects:
            if name in base.effects:
                continue
            bigger = ModelKey(
                tuple(n for n in self.names if n in (*model.key.effects, name))
            )
            model = self._with_column(model, base, name, bigger)
        u = self._secant(rival, model, model.rms)
        best = self._polished(rival, u)
        if len(key.effects) == 1 and not is_force(self.rivals.effects[key.effects[0]]):
            # Not linear in phi: it may be far from where its column was taken.
            other = super()._fit(key, [ModelKey()])
            best = min((best, other), key=lambda m: m.rms)
        return best

    def _with_column(
        self, model: LinearModel, base: ModelKey, name: str, key: ModelKey
    ) -> LinearModel:
        """Return a model with a further effect, by its column beside another model."""
        if base.effects:
            value, column = self._column(base, name)
        else:
            value, column = self.library.column(name)
        rival = self._rival(key)
        at = np.arange(rival.dim)[rival.columns()[name]]
        return enlarged(model, rival, [(np.stack([at, value]), column)])

    def _secant(self, rival: Rival, model: LinearModel, rms: float) -> Array:
        scale = max(rms, 1.0)
        known = model.residual[None] / scale, model.jacobian[None] / scale
        u = np.clip(model.u, model.low, model.high)[None]
        return self._descend(rival, u, scale, SECANT, secant=True, known=known)[0][0]

    def _polished(self, rival: Rival, u: Array) -> LinearModel:
        """Return a model linearized at the best fit from a start near it."""
        model = linearize(rival, u, self.unit, self.rivals.step)
        for _ in range(ROUNDS - 1):
            own = max(model.rms, 1.0)
            if _promised(model) < WORTH * own**2:
                break
            new = self._secant(rival, model, own)
            if (new == model.u).all():
                break
            model = linearize(rival, new, self.unit, self.rivals.step)
        return model


def _promised(model: LinearModel) -> float:
    """Return by how much its linear optimum lowers a model's sum of squares."""
    scale = max(model.rms, 1.0) ** 2
    precision = np.where(np.isfinite(model.low) & np.isfinite(model.high), 0.0, 1.0)
    weight = precision / model.sd**2
    normal = model.jacobian.T @ model.jacobian / scale + np.diag(weight + 1e-9)
    off = (model.u - model.center) * weight
    gradient = model.jacobian.T @ model.residual / scale + off
    move = np.clip(model.u - np.linalg.solve(normal, gradient), model.low, model.high)
    move = move - model.u

    def cost(r: Array, u: Array) -> float:
        return float((r**2).sum() / scale + (weight * (u - model.center) ** 2).sum())

    after = cost(model.residual + model.jacobian @ move, model.u + move)
    return (cost(model.residual, model.u) - after) * scale


def _by_sensor(c: Candidate) -> float:
    return c.log_prior + c.posterior.log_sensor


def _by_either(c: Candidate) -> float:
    return c.log_prior + c.posterior.log_evidence


def _by_process(c: Candidate) -> float:
    return c.log_p


def _by_residual(c: Candidate) -> float:
    return -c.model.rms
