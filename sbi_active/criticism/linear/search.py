"""Fits of the bare model and of sets of effects, a dozen simulations each.

A fit begins with a step to the linear optimum, by the derivatives of a smaller model
and a column of each further effect, follows secants, and ends with derivatives at its
own best fit, which its evidence rests on. Only sets that linear evidence puts near the
front are fitted: all single effects, the pairs that look best beside the bare model or
beside one of the best single effects, and larger sets grown from the best smaller ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.fits import (
    FitSettings,
    along_secants,
    as_good,
    best_fits,
    missed_by,
    onward,
    polished,
)
from sbi_active.criticism.linear.left_out import Candidate, leave_out
from sbi_active.criticism.linear.library import Library
from sbi_active.criticism.linear.mixture import Mixture, beside_process
from sbi_active.criticism.linear.model import (
    LinearModel,
    at_null,
    chords,
    enlarged,
    has_null,
)
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.detection import log_prior, log_priors
from sbi_active.seeding import derive_seed


@dataclass
class Search:
    """Fits models and keeps them.

    Args:
        rivals: The models and the trials; smooth.
        settings: Settings of what is spent on fits.

    Attributes:
        sensor: The sensor's error.
        unit: A standard deviation of each number by it, shape (N,).
        found: Fitted models, the bare one first.
        errors: Errors that all models share; known after the bare fit.
        prior: Log prior probabilities of "none" and each effect of the library.
        units: Deviations of residuals in a search, (N,); (2 N,) if it is random.
    """

    rivals: RivalSet
    settings: FitSettings = FitSettings()
    found: dict[ModelKey, Candidate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.prior = log_priors(self.rivals.library)
        self._rivals: dict[ModelKey, Rival] = {}
        self.sensor = self.rivals.sensor
        self.unit = self.units = self.sensor.typical_sd
        if self.rivals.simulator.is_stochastic:
            self.units = np.ones(2 * len(self.unit))
        self._processes: dict[bytes, ResidualProcess] = {}
        self._has_larger = False
        self._seed = derive_seed(self.rivals.seed, "misfit")
        own = self.rival(ModelKey()), self.rivals.prior_draws, self.units
        bare, *others = best_fits(*own, self.settings)
        u = np.array([other.u for other in others]).reshape(-1, own[0].dim)
        self._others = as_good(own[0], bare, u, self.units, self.settings)
        self.errors = Errors(
            self.rivals.measurements,
            self.unit,
            self.sensor,
            largest=float(np.sqrt(np.mean(bare.errors**2))),
            warm_up=self.rivals.warm_up if self.rivals.nuisances else 0.0,
            varying=bare.jacobian[: bare.num, bare.trial_of < 0],
        )
        self.keep(bare)

    @property
    def names(self) -> list[str]:
        """Effects that change the prediction, of which sets are fitted."""
        return [e.name for e in self.rivals.effects.values() if e.hook != "noise"]

    @property
    def heavy(self) -> tuple[float, Array] | None:
        """Degrees of freedom and deviation of t errors; None where errors are none."""
        df = self.sensor.cells[0].df
        return (df, self.unit) if np.isfinite(df) else None

    @cached_property
    def library(self) -> Library:
        """The bare model with the columns of all effects."""
        return self._library_of(ModelKey(), self.names)

    def model(self, key: ModelKey) -> LinearModel:
        """Return a fitted model."""
        return self.found[key].model

    def keep(self, model: LinearModel) -> Candidate:
        """Record a fitted model with its evidence."""
        grams = self.errors.grams(model)
        sensor, beside = (
            self.errors.mixture(model, grams, beside=beside) for beside in (False, True)
        )
        names = model.key.effects
        prior = log_prior(names, self.prior) if names else self.prior["none"]
        left = leave_out(model, self.errors)
        self.found[model.key] = Candidate(model, grams, sensor, beside, left, prior)
        return self.found[model.key]

    def fit_singles(self) -> None:
        """Fit each effect alone, and the bare model from where they end, once."""
        new = [n for n in self.names if ModelKey((n,)) not in self.found]
        for name in new:
            self.fit_set(ModelKey((name,)))
        if not new:
            return
        bare, rival = self.found[ModelKey()].model, self.rival(ModelKey())
        best = {key: self.columns(key, ModelKey()) for key in self._best(1)}
        u = np.array([self.found[k].model.u[own] for k, own in best.items()])
        square = ((rival.residual(u)[0] / self.units) ** 2)[:, : bare.num].mean(1)
        if square.min() < 2 * bare.rms**2:
            again = self._polished(rival, u[int(np.argmin(square))])
            if again.cost < bare.cost:
                self.keep(again)

    def fit_larger(self) -> None:
        """Fit the sets of several effects that linear evidence puts in front, once."""
        own, before = self.settings, -np.inf
        if self._has_larger:
            return
        self._has_larger = True
        for size in range(2, min(own.max_effects, len(self.names)) + 1):
            bases = self._best(size - 1)
            if (size > 2 and self.explains) or not bases:
                break
            scores: dict[ModelKey, float] = {}
            for base in [*([ModelKey()] if size == 2 else []), *bases]:
                for key, value in self._beside(base, size).items():
                    scores[key] = max(value, scores.get(key, -np.inf))
            most = own.num_pairs if size == 2 else own.num_larger
            best = sorted(scores, key=scores.__getitem__)[::-1][:most]
            for key in best:
                least = max(c.log_p_either for c in self.found.values()) - own.behind
                if scores[key] > least:
                    self.fit_set(key)
            new = [
                c.log_p_either for k, c in self.found.items() if len(k.effects) == size
            ]
            if not new or max(new) < before:
                break
            before = max(new)

    def fit_set(self, key: ModelKey) -> Candidate:
        """Fit one set of effects from its parts, once."""
        if key not in self.found:
            known = [p for p in key.parts if p in self.found]
            self.keep(self._fit(key, known or [ModelKey()]))
        return self.found[key]

    def places(self, key: ModelKey) -> Array:
        """Return a model's best fit and others that may be as good, shape (k, d).

        The bare model's are where those of larger ones may be.
        """
        u = np.tile(self.model(key).u, (1 + len(self._others), 1))
        u[1:, self.columns(key, ModelKey())] = self._others
        return u

    def smooth(self, model: LinearModel, use: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return Gram matrices of a model beside a smooth function of the action.

        It stands for what was not declared where x has no time axis.

        Args:
            model: Linear model.
            use: Parts of the trials that count, shape (f,).

        Returns:
            Gram matrices, shape (h, k, k), and log weights, shape (h,).
        """
        own = use[self.errors.fold]
        if (key := own.tobytes()) not in self._processes:
            process = self.rivals.residual_process(self.sensor, own)
            self._processes[key] = process
        process, unit = self._processes[key], self.unit[own]

        def beside(at: LinearModel) -> tuple[ResidualProcess, Array]:
            weight = np.broadcast_to(at.weight, at.num)[own]
            heavy = self.errors.is_heavy
            return process.beside(weight) if heavy else process, unit / weight

        def grams(at: LinearModel) -> tuple[Array, Array]:
            joint, wide = beside(at)
            found, log_p = joint.grams(wide[:, None] * at.rows[: at.num][own])
            gained = np.log(wide) + (at.offset - model.offset)[own]  # sensor deviations
            return found + self.errors.unchanged(at.rows, use), log_p + gained.sum()

        if not self.errors.is_heavy:
            return grams(model)

        def left(at: LinearModel, found: Mixture) -> Array:
            joint, wide = beside(at)
            rest = at.at(found.mean[None])[0]
            rest[own] = joint.left(wide * rest[own]) / wide
            return rest

        df = self.sensor.cells[0].df
        return grams(beside_process(model, grams, left, df))

    @property
    def explains(self) -> bool:
        """Whether a model leaves no more than the sensor's error."""
        least = self.settings.passes
        if not self.sensor.has_size:
            return False
        return any(c.model.chi_square[2] >= least for c in self.found.values())

    def columns(self, key: ModelKey, part: ModelKey) -> NDArray[np.bool_]:
        """Return the coordinates of a model that one with fewer effects has."""
        rival = self.rival(key)
        keep = np.ones(rival.dim, dtype=bool)
        for name in {*key.effects} - {*part.effects}:
            keep[rival.coordinates.places[name]] = False
        return keep

    def column(
        self, base: ModelKey, name: str
    ) -> tuple[LinearModel, NDArray[np.bool_]]:
        """Return a model with a further effect where it vanishes, and its columns.

        The column is a chord and no tangent: many effects are flat at their null.
        """
        key = self._joined(base, [name])
        rival, model = self.rival(key), self.found[base].model
        null, step = self._at_null(name)
        start = np.empty(rival.dim)
        own = ~self.columns(key, base)
        start[~own], start[own] = model.u, null
        slope = chords(rival, start, own, step, model, self.units)
        return enlarged(model, rival, own, null, slope), own

    def _best(self, size: int) -> list[ModelKey]:
        """Return the sets to add to: the likeliest by either error, the best fits.

        Evidence along an autocorrelated error is for what is fast; what leaves the
        smallest residual may be slow, and half of what is missing.
        """
        keys = [k for k in self.found if len(k.effects) == size]
        found = self.found
        orders = [
            sorted(keys, key=lambda k: -found[k].log_p_sensor),
            sorted(keys, key=lambda k: -found[k].log_p),
            sorted(keys, key=lambda k: found[k].model.cost),
        ]
        picked = [key for rank in zip(*orders, strict=True) for key in rank]
        return [*dict.fromkeys(picked)][: self.settings.num_bases]

    def _beside(self, base: ModelKey, size: int) -> dict[ModelKey, float]:
        """Return linear log posteriors of larger sets beside a model."""
        # A free shape beside a form of its kind says nothing, and costs columns.
        if any(map(self._free, base.effects)):
            return {}
        names = [n for n in self.names if n not in base.effects and not self._free(n)]
        library = self._library_of(base, names) if base.effects else self.library
        scores = library.scores(names, size - len(base.effects))
        found = {self._joined(base, new): value for new, value in scores.items()}
        return {key: value for key, value in found.items() if key not in self.found}

    def _library_of(self, base: ModelKey, names: Sequence[str]) -> Library:
        """Return a model with columns of effects that it lacks."""
        columns = {name: self.column(base, name) for name in names}
        model = self.found[base].model
        return Library(base, model, columns, self.errors, self.prior)

    def _joined(self, base: ModelKey, names: Iterable[str]) -> ModelKey:
        every = {*base.effects, *names}
        return ModelKey(tuple(e.name for e in self.rivals.library if e.name in every))

    def _free(self, name: str) -> bool:
        effect = self.rivals.effects[name]
        return is_force(effect) and effect.phi_dim > 1

    def _at_null(self, name: str) -> tuple[Array, Array]:
        alone = self.rival(ModelKey((name,)))
        return at_null(alone, self.rivals.effects[name], self.settings.tried)

    def rival(self, key: ModelKey) -> Rival:
        """Return a model that may be fitted."""
        if key not in self._rivals:
            is_random = self.rivals.simulator.is_stochastic
            reference = self.unit if is_random else None
            given = {"reference": reference, "heavy": self.heavy}
            self._rivals[key] = self.rivals.rival(key, **given)
        return self._rivals[key]

    def _fit(self, key: ModelKey, parents: Sequence[ModelKey]) -> LinearModel:
        """Fit a set of effects from the smaller one that leaves least."""
        rival = self.rival(key)
        parent = min(parents, key=lambda p: self.found[p].model.cost)
        base, model = parent, self.found[parent].model
        for name in key.effects:
            if name not in base.effects:
                model = self._with_column(model, parent, name)
        secant, unit = self.settings.secant, self.units * missed_by(rival, model.rms)
        fits = [self._polished(rival, onward(rival, model, self.units, secant))]
        effects = [self.rivals.effects[n] for n in key.effects]
        is_far = not all(map(has_null, effects))
        if is_far or (len(effects) == 1 and not is_force(effects[0])):
            # Not linear in phi: it may be far from where its column was taken.
            u, cost = along_secants(rival, self._starts(key, parent), unit, secant)
            fits += [self._polished(rival, p) for p in u[np.argsort(cost)[:2]]]
        best = min(fits, key=lambda fit: fit.cost)
        if best.cost > self.found[parent].model.cost:
            again = self._polished(rival, self._faint(key, parent))
            best = min(best, again, key=lambda fit: fit.cost)
        return best

    def _with_column(
        self, model: LinearModel, base: ModelKey, name: str
    ) -> LinearModel:
        """Return a model with a further effect, by its column beside another one."""
        if base.effects or name not in self.library.names:
            beside, own = self.column(base, name)
        else:
            beside, own = self.library.columns[name]
        key = self._joined(model.key, [name])
        new = ~self.columns(key, model.key)
        return enlarged(
            *(model, self.rival(key), new, beside.u[own], beside.jacobian[:, own])
        )

    def _starts(self, key: ModelKey, parent: ModelKey) -> Array:
        """Return starts of a set's fit beside its linear optimum, shape (n, d)."""
        own, rival, model = self.settings, self.rival(key), self.found[parent].model
        c, shared = rival.coordinates, self.columns(key, parent)
        u = c.sample(own.num_drawn, seed=derive_seed(self._seed, str(key)))
        u[:, shared] = model.u
        starts = [u]
        if not all(has_null(self.rivals.effects[n]) for n in key.effects):
            seed = derive_seed(self._seed, str(key), "screened")
            far = c.sample(own.num_far, seed=seed)
            square = ((rival.residual(far)[0] / self.units) ** 2).sum(1)
            starts.append(far[np.argsort(square)[: own.num_kept_far]])
        return np.clip(np.concatenate(starts), c.low, c.high)

    def _faint(self, key: ModelKey, parent: ModelKey) -> Array:
        """Return a fit with further effects that hardly act, shape (d,).

        A set fits no worse than its part. Where it seems to, its fit was lost where an
        effect as strong as its prior holds the machine still, or throws it about.
        """
        rival, model = self.rival(key), self.found[parent].model
        u, columns = np.empty(rival.dim), rival.coordinates.places
        u[self.columns(key, parent)] = model.u
        for name in {*key.effects} - {*parent.effects}:
            null, step = self._at_null(name)
            u[columns[name]] = null + self.settings.faint * step
        return u

    def _polished(self, rival: Rival, u: Array) -> LinearModel:
        return polished(rival, u, self.units, self.settings)
