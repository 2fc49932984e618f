"""The verdict where some model fits to the sensor's error, by linear evidence alone.

Which effect is missing is told with the rules of the sampled evidence: the alarm, prior
probabilities, catch-alls, and what a trial's gross error may have done. Forces of one
family are alternatives of one cause: the family is chosen first, then its form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.linear.errors import Posterior
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.catch_alls import (
    log_one_part,
    log_scaled,
    log_without,
)
from sbi_active.criticism.misfit.record import detection_of, keep_draws
from sbi_active.criticism.results import (
    CATCH_ALLS,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Evidence,
    ModelKey,
)
from sbi_active.criticism.rivals.error_models import NoiseGrid
from sbi_active.criticism.rivals.noise_grid import scattered
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.criticism.steps.detection import (
    LEVEL,
    REFUTED,
    THRESHOLD,
)
from sbi_active.criticism.steps.tracing import (
    log_bayes_factor,
    log_priors,
    probabilities_of,
    verdict_of,
)
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


@dataclass
class BySensor:
    """Linear models of which one fits to the sensor's error.

    Attributes:
        search: Search with its models.
        rivals: Rivals that the models are made of.
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
        noise = scattered(NoiseGrid(self.search.cells))  # in units of the sensor
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
        if len(self._one_part):
            return CATCH_ALLS
        return tuple(name for name in CATCH_ALLS if name != OUTLIER)

    def detected(self) -> Detection:
        """Return whether the bare model misses the trials."""
        level = LEVEL if self.rivals.has_known_noise else 0.0
        log_b = log_bayes_factor(self._log_z, self)
        bare = self.search.found[ModelKey()]
        square, p = self._chi_square(ModelKey())
        found = detection_of(bare, log_b, level)
        found = replace(found, chi_square=square, p_value=p)
        noise, spare = (
            self.rivals.model.noise,
            len(bare.model.residual) - len(bare.model.u),
        )
        is_declared = noise is not None and noise.posterior is None and spare > 0
        if not is_declared or self.rivals.roughness.any():
            return found
        lower = float(chi2.cdf(square, spare))
        return replace(found, least_chi_square=square, lower_p_value=lower)

    def _chi_square(self, key: ModelKey) -> tuple[float, float]:
        """Return a model's chi-square and its tail, by all that is declared.

        Where the correlation of errors is declared it counts; where it is unknown,
        numbers count as independent.
        """
        model, cells = self.search.model(key), self.search.errors.cells
        square, freedom, p = model.chi_square
        if len(cells) == 1 and cells[0].rho.any():
            square = float((cells[0].whiten(model.residual) ** 2).sum())
            p = float(chi2.sf(square, freedom))
        return square, p

    def log_evidence(self, key: ModelKey, *, factor: float = 1.0) -> float:
        """Return a model's log evidence, priors of effects as many times as wide."""
        if factor == 1 or key not in self.search.found:
            return self._log_z[key]
        c, errors = self.search.found[key], self.search.errors
        own = errors.posterior(c.model, c.grams, factor=factor, process=False)
        return own.log_sensor

    def larger(
        self, singles: Mapping[str, float], prior: Mapping[str, float]
    ) -> dict[ModelKey, float]:
        """Return log posteriors of sets of several effects, where they gain enough."""
        return self._gaining(self._log_z, prior)

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
        return bool(names.effects) and self.p_value(names) < REFUTED

    def log_with_process(self, key: ModelKey) -> float:
        """Return the log evidence of effects with a residual process beside them."""
        return self.search.found[self._predicting(key)].posterior.log_process

    def record(self, key: ModelKey) -> Evidence:
        """Return the record of a model, and keep its draws."""
        log_z, bare = self._log_z[key], ModelKey()
        if key.error is not None:
            return replace(self.record(bare), key=key, log_evidence=log_z)
        if key not in self.search.found:  # on the noise, sampled
            return replace(self.rivals.fit(key).evidence, log_evidence=log_z)
        model = self.search.model(key)
        use = np.ones(self.search.errors.num_folds, bool)
        own = self.posterior(key, use)
        kept = keep_draws(self.rivals, model, own.mean, own.cov, log_z)
        return replace(kept, log_evidence=log_z)

    def outliers(self) -> dict[float, float]:
        """Return the probability that each trial is the one with a gross error."""
        if not len(self._one_part):
            return {}
        share = np.exp(self._one_part - log_sum_exp(self._one_part))
        index = self.rivals.trials.index.numpy()
        trials = np.unique(self.rivals.measurements.trial)
        order = np.argsort(-share, kind="stable")
        return {float(index[trials[k]]): float(share[k]) for k in order}

    def needed(self, key: ModelKey) -> tuple[float, ...]:
        """Return the trials without which the data do not point to some effects."""
        errors, found = self.search.errors, self.search.found
        log_b = self._log_z[key] - self._log_z[ModelKey()]
        if key not in found or log_b < THRESHOLD or not errors.is_by_trial:
            return ()
        own, bare = (log_without(found[k], errors) for k in (key, ModelKey()))
        trials = np.unique(self.rivals.measurements.trial)
        index = self.rivals.trials.index.numpy()[trials]
        return (*index[own - bare < THRESHOLD].tolist(),)

    def p_value(self, key: ModelKey) -> float:
        """Return the tail probability of a model's chi-square."""
        return self._chi_square(self._predicting(key))[1]

    def log_process(self, key: ModelKey) -> float:
        """Return the log Bayes factor of a residual process beside a model, nats."""
        own = self.search.found[self._predicting(key)].posterior
        return own.log_process - own.log_sensor

    def _predicting(self, key: ModelKey) -> ModelKey:
        """Return the effects of a set that change the prediction."""
        names = self.search.names
        return ModelKey(tuple(n for n in key.effects if n in names))
