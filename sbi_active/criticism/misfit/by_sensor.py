"""The verdict where some model fits to the sensor's error, by linear evidence alone.

Which effect is missing is told with the rules of the sampled evidence: the alarm, prior
probabilities, catch-alls, and what a trial's gross error may have done. Forces of one
family are alternatives of one cause: the family is chosen first, then its form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.actions import ActionSpace
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.linear.errors import Posterior
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.catch_alls import (
    log_one_part,
    log_scaled,
    log_without,
)
from sbi_active.criticism.misfit.record import alike, detection_of, keep_draws
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Evidence,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.rivals.noise_grid import scattered
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.criticism.steps.detection import (
    LEVEL,
    REFUTED,
    THRESHOLD,
    alternatives,
)
from sbi_active.criticism.steps.equivalence import equivalent_effects
from sbi_active.criticism.steps.influence import is_left_to_chance, withdrawn
from sbi_active.criticism.steps.near_aliases import near_aliases
from sbi_active.criticism.steps.tracing import (
    RESCALED,
    beside_imitations,
    credible_set,
    estimate_of,
    likeliest_first,
    log_priors,
    probabilities_of,
)
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

#: Probability from which a set of several effects is recorded with draws.
SHOWN = 0.002


@dataclass
class BySensor:
    """Linear models of which one fits to the sensor's error.

    Attributes:
        search: Its models.
        rivals: They are made of.
        equivalent: Groups of effects that no permitted action separates.
    """

    search: Search
    rivals: RivalSet
    equivalent: Sequence[frozenset[str]] = ()
    _log_z: dict[ModelKey, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.search.fit_singles()
        errors, log_z = self.search.errors, self._log_z
        found = self.search.found
        log_z |= {key: c.posterior.log_sensor for key, c in found.items()}
        bare = found[ModelKey()]
        log_z[ModelKey(error=UNEXPLAINED)] = bare.posterior.log_process
        noise = scattered(self.rivals.noise)
        scaled = log_scaled(bare, errors, noise.scales[:, None])
        log_z[ModelKey(error=SCATTER)] = float(
            log_sum_exp(scaled + noise.log_scale_prior)
        )
        # No column tells of effects on the noise alone, whose evidence is sampled.
        noisy = [n for n, e in self.rivals.effects.items() if e.hook == "noise"]
        if noisy:
            shift = bare.posterior.log_sensor - log_evidence(self.rivals)[0]
            for key in (ModelKey((n,)) for n in noisy):
                log_z[key] = shift + log_evidence(self.rivals, key)[0]
        self._one_part = np.empty(0)
        if errors.is_by_trial:
            self._one_part = log_one_part(bare, errors)
            total = log_sum_exp(self._one_part) - np.log(errors.num_folds)
            log_z[ModelKey(error=OUTLIER)] = float(total)
        if self.detected().alarm:
            self.search.fit_larger()
            log_z |= {key: c.posterior.log_sensor for key, c in found.items()}

    def posterior(self, key: ModelKey, use: NDArray[np.bool_]) -> Posterior:
        """Return the posterior of a model by some parts of the trials."""
        c = self.search.found[key]
        return self.search.errors.posterior(c.model, c.grams, use, process=False)

    def selected_without(self, fold: int) -> ModelKey:
        """Return the model that is chosen without one part of the trials."""
        use = np.arange(self.search.errors.num_folds) != fold
        found = self.search.found
        log_z = {key: self.posterior(key, use).log_sensor for key in found}
        log_b = self._log_bayes_factor(log_z)
        if log_b < THRESHOLD and self.detected().p_value > LEVEL:
            return ModelKey()
        return self._verdict(self._log_p(log_z))

    def detected(self) -> Detection:
        """Return whether the bare model misses the trials."""
        level = LEVEL if self.rivals.has_known_noise else 0.0
        log_b = self._log_bayes_factor(self._log_z)
        found = detection_of(self.search.found[ModelKey()], log_b, level)
        noise = self.rivals.model.noise
        if noise is None or noise.posterior is not None or self.rivals.roughness.any():
            return found
        least, freedom = found.chi_square, found.degrees_of_freedom
        p = float(chi2.cdf(least, freedom))
        return replace(found, least_chi_square=least, lower_p_value=p)

    def traced(self, actions: ActionSpace | None, *, compare: bool) -> Tracing:
        """Return which effects the trials point to, and record the models' draws.

        Args:
            actions: The permitted ones, for what they hardly separate.
            compare: Whether to look for effects that are nearly the same over them, and
                for those that the trials do not separate.
        """
        rivals, found, detection = self.rivals, self.search.found, self.detected()
        log_z = dict(self._log_z)
        if not detection.alarm:
            log_z.pop(ModelKey(error=OUTLIER), None)
        log_p = self._log_p(log_z)
        verdict = self._verdict(log_p) if detection.alarm else ModelKey()
        beside: tuple[str, ...] = ()
        if self._predicting(verdict) and found[verdict].model.chi_square[2] < REFUTED:
            process = ModelKey(error=UNEXPLAINED)
            both = found[verdict].posterior.log_process, log_z[process]
            log_z[process] = float(np.logaddexp(*both) - np.log(2))
            log_p = self._log_p(log_z)
            if self._verdict(log_p) == process and both[0] > both[1]:
                beside = verdict.effects
            verdict = self._verdict(log_p)
        p = beside_imitations(probabilities_of(log_p))
        probabilities = {str(key): share for key, share in p.items()}
        inclusion = {
            name: sum(share for key, share in p.items() if name in key.effects)
            for name in rivals.effects
        }
        evidences = {
            str(key): self._recorded(key, log_z[key])
            for key, share in p.items()
            if len(key.effects) < 2 or share >= SHOWN or key == verdict
        }
        null = log_z[ModelKey()]
        estimates = likeliest_first(
            estimate_of(
                effect,
                evidences[name],
                probability=inclusion[name],
                log_bayes_factor=log_z[ModelKey((name,))] - null,
            )
            for name, effect in rivals.effects.items()
            if name in evidences
        )
        near, aliases = (), ()
        if compare:
            near = equivalent_effects(rivals, None)
        if compare and detection.alarm:
            known = [*self.equivalent, *near]
            singles = {n: log_z[ModelKey((n,))] for n in rivals.effects}
            aliases = near_aliases(rivals, singles, actions, known)
        elif detection.alarm:
            aliases = self._aliases(log_z)
        fitted = found[ModelKey(self._predicting(verdict))]
        tracing = Tracing(
            verdict=str(verdict),
            chosen=verdict.effects,
            probabilities=probabilities,
            inclusion=inclusion,
            credible_set=credible_set(probabilities),
            equivalent=(*self.equivalent,),
            near=near,
            aliases=aliases,
            estimates=estimates,
            evidences=evidences,
            robust=self._is_robust(verdict),
            beside=beside,
            outliers=self._outliers() if detection.alarm else {},
            needed=self._needed(verdict),
            p_value=fitted.model.chi_square[2],
            log_process=fitted.posterior.log_process - fitted.posterior.log_sensor,
            trial_names=dict(
                zip(rivals.trials.index.tolist(), rivals.trials.names, strict=True)
            ),
        )
        return withdrawn(tracing) if is_left_to_chance(tracing) else tracing

    def _log_bayes_factor(self, log_z: dict[ModelKey, float]) -> float:
        weights = alternatives([e.name for e in self.rivals.library], self.equivalent)
        parts = [
            log_z[ModelKey.of(name)] + float(np.log(w))
            for name, w in weights.items()
            if ModelKey.of(name) in log_z
        ]
        return float(log_sum_exp(np.array(parts)) - log_z[ModelKey()])

    def _log_p(self, log_z: dict[ModelKey, float]) -> dict[ModelKey, float]:
        """Return unnormalized log posteriors; sets that gain too little do not count.

        A set counts if it has a Bayes factor of 20 against each of its parts.
        """
        some = [name for name in CATCH_ALLS if ModelKey(error=name) in log_z]
        prior = log_priors(self.rivals.library, some)
        log_p = {}
        for key, value in log_z.items():
            parts = [log_z[part] for part in key.parts if part in log_z]
            if len(key.effects) > 1 and value < max(parts, default=-np.inf) + THRESHOLD:
                continue
            several = len(key.effects) > 1
            own = log_prior(key.effects, prior) if several else prior[str(key)]
            log_p[key] = value + own
        return log_p

    def _verdict(self, log_p: dict[ModelKey, float]) -> ModelKey:
        """Return the most probable set of the most probable families."""
        p = probabilities_of(log_p)
        errors = {key: share for key, share in p.items() if key.error}
        declared = {key: share for key, share in p.items() if key.effects}
        if errors and max(errors.values()) > sum(declared.values()):
            return max(errors, key=errors.__getitem__)
        classes: dict[frozenset[str], dict[ModelKey, float]] = {}
        for key, share in declared.items():
            classes.setdefault(self._families(key), {})[key] = share
        if not classes:
            return ModelKey()
        likeliest = max(classes.values(), key=lambda members: sum(members.values()))
        return max(likeliest, key=likeliest.__getitem__)

    def _families(self, key: ModelKey) -> frozenset[str]:
        """Return what a set is about: families of forces, groups of what is alike."""
        effects = [self.rivals.effects[name] for name in key.effects]
        groups = [group for group in self.equivalent if NONE not in group]
        return frozenset(
            str(e.family)
            if is_force(e)
            else min(next((g for g in groups if e.name in g), {e.name}))
            for e in effects
        )

    def _predicting(self, key: ModelKey) -> tuple[str, ...]:
        """Return the effects of a set that change the prediction."""
        return tuple(n for n in key.effects if n in self.search.names)

    def _recorded(self, key: ModelKey, log_z: float) -> Evidence:
        if key.error is not None:
            own = self._recorded(ModelKey(), self._log_z[ModelKey()])
            return replace(own, key=key, log_evidence=log_z)
        if key not in self.search.found:  # on the noise, sampled
            return replace(self.rivals.fit(key).evidence, log_evidence=log_z)
        c = self.search.found[key]
        use = np.ones(self.search.errors.num_folds, bool)
        posterior = self.posterior(key, use)
        own = keep_draws(self.rivals, c.model, posterior.mean, posterior.cov, log_z)
        return replace(own, log_evidence=log_z)

    def _aliases(self, log_z: dict[ModelKey, float]) -> tuple[frozenset[str], ...]:
        names = [n for n in self.search.names if ModelKey((n,)) in self.search.found]
        return alike(self.search, {n: log_z[ModelKey((n,))] for n in names})

    def _is_robust(self, verdict: ModelKey) -> bool:
        """Return whether priors a third and three times as wide give the same."""
        errors = self.search.errors
        for factor in RESCALED:
            log_z = dict(self._log_z)
            for key, c in self.search.found.items():
                if key.effects:
                    log_z[key] = errors.posterior(
                        c.model, c.grams, factor=factor, process=False
                    ).log_sensor
            is_none = self._log_bayes_factor(log_z) < THRESHOLD
            if is_none and not self.detected().by_chi_square:
                found = ModelKey()
            else:
                found = self._verdict(self._log_p(log_z))
            if self._families(found) != self._families(verdict) or (
                found.error != verdict.error
            ):
                return False
        return True

    def _outliers(self) -> dict[float, float]:
        """Return the probability that each trial is the one with a gross error."""
        if not len(self._one_part):
            return {}
        share = np.exp(self._one_part - log_sum_exp(self._one_part))
        index = self.rivals.trials.index.numpy()
        trials = np.unique(self.rivals.measurements.trial)
        order = np.argsort(-share, kind="stable")
        return {float(index[trials[k]]): float(share[k]) for k in order}

    def _needed(self, key: ModelKey) -> tuple[float, ...]:
        """Return the trials without which the data do not point to some effects."""
        errors, found = self.search.errors, self.search.found
        log_b = self._log_z[key] - self._log_z[ModelKey()]
        if (
            not key.effects
            or key not in found
            or log_b < THRESHOLD
            or not errors.is_by_trial
        ):
            return ()
        own, bare = (log_without(found[k], errors) for k in (key, ModelKey()))
        trials = np.unique(self.rivals.measurements.trial)
        index = self.rivals.trials.index.numpy()[trials]
        return (*index[own - bare < THRESHOLD].tolist(),)
