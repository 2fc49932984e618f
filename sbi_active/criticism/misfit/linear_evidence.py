"""Evidence of linear models in closed form: no trial is simulated for it.

A larger noise scales all Gram matrices. A gross error is a residual process in one
trial alone, whichever it is; what is "unexplained", a process in all of them, and
without a time axis a smooth function of the action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.errors import WIDTHS, Mixture, Posterior, summed
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.record import detection_of, keep_draws
from sbi_active.criticism.misfit.verdict import FEWEST_TRIALS
from sbi_active.criticism.results import (
    CATCH_ALLS,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Evidence,
    ModelKey,
)
from sbi_active.criticism.rivals.noise_grid import inflations
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.criticism.steps.detection import LEVEL, REFUTED, THRESHOLD
from sbi_active.criticism.steps.equivalence import is_large
from sbi_active.criticism.steps.tracing import (
    log_bayes_factor,
    log_priors,
    probabilities_of,
    verdict_of,
)
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.support import support_bounds, support_of

Array = NDArray[Any]

#: Draws of an effect on the noise, over which its evidence is a mean.
NUM_LOUDER = 200


def is_linear(search: Search) -> bool:
    """Return whether linear models tell the simulator's apart, or have to.

    They follow no jumps, and without a time axis not which trials have an outcome.
    Samples of trajectories of a large library would take too long. Where models bend,
    evidence about their best fits decides as that of samples does.
    """
    rivals = search.rivals
    jumps = not rivals.is_smooth or bool(rivals.roughness.any())
    if rivals.measurements.is_sequence:
        return is_large(rivals.library) or not jumps
    return not (rivals.can_fail or jumps)


def bends(search: Search, key: ModelKey, *, num: int = 16, most: float = 0.5) -> bool:
    """Return whether the simulator leaves a linear model where its posterior lies.

    A normal posterior is then another one than the simulator's.

    Args:
        search: Search that has fitted the model.
        key: Key of the model.
        num: Number of posterior draws that are simulated.
        most: Standard deviation over the draws of the log density ratio of simulator
            and linear model up to which a model counts as linear, nats. With half, more
            models are sampled.
    """
    c = search.found[key]
    m, rng = c.model, np.random.default_rng(derive_seed(search.rivals.seed, "bends"))
    use = np.ones(search.errors.num_folds, bool)
    own = search.errors.posterior(m, c.grams, use, process=False)
    values, vectors = eigh(own.cov)
    spread = vectors * np.sqrt(np.maximum(values, 0))
    u = own.mean + rng.standard_normal((num, len(m.u))) @ spread.T
    u = np.clip(u, m.low, m.high)
    residual = search.rivals.rival(key).residual(u)[0]
    linear = search.unit * (m.residual + (u - m.u) @ m.jacobian.T)
    log_p = search.sensor.noise.log_likelihood
    return not (log_p(residual) - log_p(linear)).std() < most  # NaN: not simulated


@dataclass
class LinearEvidence:
    """Evidence of linear models, of which one may fit to the sensor's error.

    Attributes:
        search: Search with its models.
        rivals: Rivals that the models are made of.
        equivalent: Groups of effects that no permitted action separates.
    """

    search: Search
    rivals: RivalSet
    equivalent: Sequence[frozenset[str]] = ()
    _summed: dict[ModelKey, Mixture] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.search.fit_singles()
        if self.detected().alarm and self.search.look_again():
            self._summed.clear()
        self.record(ModelKey())  # what is asked first does not matter
        if self.detected().alarm:
            self.search.fit_larger()

    def posterior(self, key: ModelKey, use: NDArray[np.bool_]) -> Posterior:
        """Return the posterior of a model by some parts of the trials."""
        c = self.search.found[key]
        return self.search.errors.posterior(c.model, c.grams, use, process=False)

    def selected_without(self, fold: int) -> ModelKey:
        """Return the model that is chosen without one part of the trials."""
        use = np.arange(self.search.errors.num_folds) != fold
        found = self.search.found
        log_z = {key: self.posterior(key, use).log_sensor for key in found}
        log_b = log_bayes_factor(log_z, self)
        if log_b < THRESHOLD and self.detected().p_value > LEVEL:
            return ModelKey()
        prior = log_priors(self.rivals.library, ())
        log_p = {k: v + prior[str(k)] for k, v in log_z.items() if len(k.effects) < 2}
        log_p |= self._gaining(log_z, prior)
        return verdict_of(probabilities_of(log_p), self)

    @property
    def catch_alls(self) -> tuple[str, ...]:
        """Catch-alls that are compared after an alarm."""
        if len(self.search.errors.trials) >= FEWEST_TRIALS:
            return CATCH_ALLS
        return tuple(name for name in CATCH_ALLS if name != OUTLIER)

    def detected(self) -> Detection:
        """Return whether the bare model misses the trials."""
        names = (UNEXPLAINED, SCATTER, *self.rivals.effects)
        keys = [ModelKey(), *map(ModelKey.of, names)]
        log_b = log_bayes_factor({k: self.log_evidence(k) for k in keys}, self)
        level = LEVEL if self.rivals.has_known_noise else 0.0
        bare = self.search.found[ModelKey()]
        square, p = self._chi_square(ModelKey())
        found = detection_of(bare, log_b, level)
        found = replace(found, chi_square=square, p_value=p)
        noise = self.rivals.model.noise
        spare = len(bare.model.residual) - len(bare.model.u)
        is_declared = noise is not None and noise.posterior is None and spare > 0
        if not is_declared or self.rivals.roughness.any():
            return found
        lower = float(chi2.cdf(square, spare))
        return replace(found, least_chi_square=square, lower_p_value=lower)

    def _chi_square(self, key: ModelKey) -> tuple[float, float]:
        """Return a model's chi-square and its tail, by all that is declared.

        Of effects on the noise it is the smallest among draws of their posterior. Where
        the correlation of errors is declared it counts; where it is unknown, numbers
        count as independent.
        """
        cells = self.search.errors.cells
        model = self.search.model(self._predicting(key))
        residual, (square, freedom, p) = model.residual[None], model.chi_square
        if is_louder := bool(self._louder(key)):
            residual = residual / self._louder_draws(key)[1]
        if is_correlated := len(cells) == 1 and cells[0].rho.any():
            residual = cells[0].whiten(residual)
        if is_louder or is_correlated:
            square = float((residual**2).sum(1).min())
            p = float(chi2.sf(square, freedom))
        return square, p

    def log_evidence(self, key: ModelKey, *, factor: float = 1.0) -> float:
        """Return a model's log evidence, priors of effects as many times as wide."""
        if factor == 1 or key.error is not None:
            return self._mixture(key).log_evidence
        return self._summed_out(key, factor).log_evidence

    def _mixture(self, key: ModelKey) -> Mixture:
        """Return a model's posterior, computed once."""
        if key not in self._summed:
            self._summed[key] = self._summed_out(key)
        return self._summed[key]

    def _summed_out(self, key: ModelKey, factor: float = 1.0) -> Mixture:
        """Return a model's posterior, priors of effects as many times as wide."""
        predicting = self._predicting(key)
        c, errors = self.search.found[predicting], self.search.errors
        n, widths = len(errors.log_sensor), [factor * width for width in WIDTHS]
        rows, timed = c.model.rows, self.rivals.measurements.is_sequence
        if key.error == SCATTER:
            factors = inflations()
            grams, log_weight = errors.scaled(rows, factors[:, None])
            log_weight -= np.log(len(factors))
        elif key.error == OUTLIER:
            grams, log_weight = errors.one_trial(c.model, c.grams)
        elif key.error and not (timed and self.search.sensor.is_known):
            return self.search.beside_smooth(predicting)
        elif louder := self._louder(key):
            scale = self._scales(louder, factor)[1]
            grams, log_weight = errors.scaled(rows, scale)
            return summed(grams, log_weight - np.log(len(scale)), c.model, widths)
        else:
            own = slice(n, None) if key.error else slice(n)
            prior = errors.log_prior if key.error else errors.log_sensor
            grams = c.grams.gram[own].sum(1)
            log_weight = prior + errors.constants(c.grams)[own]
        return summed(grams, log_weight, c.model, (1.0,) if key.error else widths)

    def _louder(self, key: ModelKey) -> list[Effect]:
        """Return the effects of a set that act on the noise alone."""
        effects = [self.rivals.effects[name] for name in key.effects]
        return [e for e in effects if e.hook == "noise"]

    def _scales(self, effects: Sequence[Effect], factor: float) -> tuple[Array, Array]:
        """Return draws of effects on the noise, and its factors, (n, k) and (n, N)."""
        parts = []
        for e in effects:
            with forked_generators(self.rivals.seed, "louder", e.name):
                phi = e.sample(NUM_LOUDER).double()
            null = e.null_phi(1)
            ends = np.stack(support_bounds(support_of(e.prior), e.phi_dim))
            if bool(null.isfinite().all()) and not np.isfinite(ends).all(0).any():
                width = torch.tensor(factor * np.resize(WIDTHS, NUM_LOUDER))
                phi = null + width[:, None] * (phi - null)
            parts.append(phi)
        named = {e.name: phi for e, phi in zip(effects, parts, strict=True)}
        scale = self.rivals.simulator.noise_scale(named, NUM_LOUDER)
        assert scale is not None
        phi = np.concatenate([part.numpy() for part in parts], 1)
        return phi, np.maximum(scale, 1e-12)

    def _louder_draws(self, key: ModelKey) -> tuple[Array, Array]:
        """Return posterior draws of a set's effects on the noise, and its factors."""
        rng = np.random.default_rng(derive_seed(self.rivals.seed, "louder"))
        share = self._mixture(key).share.reshape(-1, NUM_LOUDER).sum(0)
        drawn = rng.choice(NUM_LOUDER, size=NUM_LOUDER, p=share / share.sum())
        phi, scale = self._scales(self._louder(key), 1.0)
        return phi[drawn], scale[drawn]

    def larger(
        self, singles: Mapping[str, float], prior: Mapping[str, float]
    ) -> dict[ModelKey, float]:
        """Return log posteriors of sets of several effects, where they gain enough."""
        noisy = [n for n in singles if n not in self.search.names]
        others = [n for n in singles if n in self.search.names]
        keys = [*self.search.found]
        if noisy and others:  # the best effect with each on the noise
            best = max(others, key=singles.__getitem__)
            every = self.rivals.effects
            pairs = ({best, name} for name in noisy)
            keys += [ModelKey(tuple(n for n in every if n in pair)) for pair in pairs]
            keys += [ModelKey((name,)) for name in noisy]
        return self._gaining({key: self.log_evidence(key) for key in keys}, prior)

    def _gaining(
        self, log_z: Mapping[ModelKey, float], prior: Mapping[str, float]
    ) -> dict[ModelKey, float]:
        """Return log posteriors of sets with a Bayes factor of 20 against each part."""
        found = {}
        for key, value in log_z.items():
            parts = [log_z[part] for part in key.parts if part in log_z]
            if len(key.effects) > 1 and value >= max(parts) + THRESHOLD:
                found[key] = value + log_prior(key.effects, prior)
        return found

    def is_refuted(self, key: ModelKey, detection: Detection) -> bool:
        """Return whether the sensor leaves no room for what a model leaves over."""
        names = self._predicting(key)
        return bool(names.effects) and self.p_value(key) < REFUTED  # NaN: never

    def log_with_process(self, key: ModelKey) -> float:
        """Return the log evidence of effects with a residual process beside them."""
        return self.log_evidence(ModelKey(key.effects, UNEXPLAINED))

    def record(self, key: ModelKey) -> Evidence:
        """Return the record of a model, and keep its draws.

        The bare model and those that are likely have samples of the simulator's own
        posterior where they bend.
        """
        own, model = self._mixture(key), self.search.model(self._predicting(key))
        if key not in self.rivals.fits and self._is_sampled(key):
            fit = self.rivals.fit(key)
            found = replace(fit.evidence, log_evidence=own.log_evidence)
            self.rivals.fits[key] = replace(fit, evidence=found)
            return found
        given = self.rivals, key, model, own.mean, own.cov, own.log_evidence
        if not self._louder(key):
            return keep_draws(*given, unit=self.search.unit)
        phi, square = self._louder_draws(key)[0], self._chi_square(key)[0]
        return keep_draws(*given, louder=phi, chi_square=square)

    def _is_sampled(self, key: ModelKey) -> bool:
        if self.rivals.measurements.is_sequence or key not in self.search.found:
            return False
        likely = max(mixture.log_evidence for mixture in self._summed.values())
        if key.effects and self.log_evidence(key) < likely - THRESHOLD:
            return False
        return bends(self.search, key)

    def outliers(self) -> dict[float, float]:
        """Return the probability that each trial is the one with a gross error."""
        if OUTLIER not in self.catch_alls:
            return {}
        index = self.rivals.trials.index.numpy()
        trials = np.unique(self.rivals.measurements.trial)
        share = self._mixture(ModelKey(error=OUTLIER)).share
        share = share.reshape(len(trials), -1).sum(1)
        order = np.argsort(-share, kind="stable")
        return {float(index[trials[k]]): float(share[k]) for k in order}

    def needed(self, key: ModelKey) -> tuple[float, ...]:
        """Return the trials without which the data do not point to some effects."""
        bare, found = ModelKey(), self.search.found
        log_b = self.log_evidence(key) - self.log_evidence(bare)
        if key not in found or log_b < THRESHOLD or OUTLIER not in self.catch_alls:
            return ()
        without = [
            self.posterior(key, ~own).log_sensor - self.posterior(bare, ~own).log_sensor
            for own in self.search.errors.trials
        ]
        trials = np.unique(self.rivals.measurements.trial)
        index = self.rivals.trials.index.numpy()[trials]
        return (*index[np.array(without) < THRESHOLD].tolist(),)

    def p_value(self, key: ModelKey) -> float:
        """Return the tail probability of a model's chi-square; NaN without a size."""
        if not self.search.sensor.is_known:
            return float("nan")
        return self._chi_square(key)[1]

    def log_process(self, key: ModelKey) -> float:
        """Return the log Bayes factor of a residual process beside a model, nats."""
        key = self._predicting(key)
        return self.log_with_process(key) - self.log_evidence(key)

    def _predicting(self, key: ModelKey) -> ModelKey:
        """Return the effects of a set that change the prediction."""
        names = self.search.names
        return ModelKey(tuple(n for n in key.effects if n in names))
