"""Evidence of the models by samples of their posteriors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import (
    CATCH_ALLS,
    OUTLIER,
    UNEXPLAINED,
    Detection,
    Evidence,
    ModelKey,
)
from sbi_active.criticism.steps.combinations import grow, log_prior
from sbi_active.criticism.steps.detection import REFUTED, THRESHOLD, detect
from sbi_active.criticism.steps.influence import needed_trials

Array = NDArray[Any]


class LinearFits(Protocol):
    """Models linear at their best fits."""

    def fit_singles(self) -> None:
        """Fit each effect alone."""
        ...

    def fit_larger(self) -> None:
        """Fit sets of several effects."""
        ...

    def best_fits(self) -> dict[ModelKey, Array]:
        """Return the coordinates of the best fits."""
        ...

    def worthy(self) -> list[ModelKey]:
        """Return sets of several effects worth a sample, smaller ones first."""
        ...


@dataclass
class Sampled:
    """Models of any simulator, each fitted and sampled once it is asked for.

    Where derivatives mean something, linear models say where a posterior is and which
    sets of effects are worth a sample, and samples what their evidence is.

    Attributes:
        rivals: The models.
        equivalent: Groups of effects that no permitted action separates.
        linear: Linear models; None if there are none.
    """

    rivals: RivalSet
    equivalent: Sequence[frozenset[str]] = ()
    linear: LinearFits | None = None

    def __post_init__(self) -> None:
        if self.linear is not None:
            self.linear.fit_singles()
            self.rivals.best_fits |= self.linear.best_fits()

    @property
    def catch_alls(self) -> tuple[str, ...]:
        """Catch-alls that are compared after an alarm."""
        return CATCH_ALLS

    def detected(self) -> Detection:
        """Return whether the bare model misses the trials."""
        return detect(self.rivals, self.equivalent)

    def log_evidence(self, key: ModelKey, *, factor: float = 1.0) -> float:
        """Return a model's log evidence, priors of effects as many times as wide."""
        return log_evidence(self.rivals, key, factor=factor)[0]

    def larger(
        self, singles: Mapping[str, float], prior: Mapping[str, float]
    ) -> dict[ModelKey, float]:
        """Return log posteriors of sets of several effects, where they gain enough."""
        if self.linear is None:
            return grow(self.rivals, dict(singles), dict(prior))
        self.linear.fit_larger()
        self.rivals.best_fits |= self.linear.best_fits()
        found: dict[ModelKey, float] = {}
        for key in [*self.linear.worthy(), *self._noisy(singles)]:
            value = self.log_evidence(key)
            if value > max(map(self.log_evidence, key.parts)) + THRESHOLD:
                found[key] = value + log_prior(key.effects, prior)
        return found

    def _noisy(self, singles: Mapping[str, float]) -> list[ModelKey]:
        """Return the best effect with each on the noise, of which no column tells."""
        effects = self.rivals.effects
        noisy = [n for n, e in effects.items() if e.hook == "noise"]
        others = [n for n in singles if n not in noisy]
        if not others:
            return []
        best = max(others, key=singles.__getitem__)
        pairs = ({best, name} for name in noisy)
        return [ModelKey(tuple(n for n in effects if n in pair)) for pair in pairs]

    def is_refuted(self, key: ModelKey, detection: Detection) -> bool:
        """Return whether known noise leaves no room for what a model leaves over."""
        return detection.refutes(self.rivals.fit(key).evidence, REFUTED)

    def log_with_process(self, key: ModelKey) -> float:
        """Return the log evidence of effects with a residual process beside them."""
        both = ModelKey(key.effects, UNEXPLAINED)
        return self.rivals.fit(both).evidence.log_evidence

    def record(self, key: ModelKey) -> Evidence:
        """Return the record of a model, its evidence under unknown scales."""
        value, error = log_evidence(self.rivals, key)
        own = self.rivals.fit(key).evidence
        return replace(own, log_evidence=value, standard_error=error)

    def outliers(self) -> dict[float, float]:
        """Return the probability that each trial is the one, if one has a gross error.

        Keys are the trials' indices, most probable first.
        """
        _, weights, residual = self.rivals.fit(ModelKey(error=OUTLIER)).weighted()
        error = self.rivals.one_outlier()
        share = weights @ error.responsibility(residual)
        order = np.argsort(-share, kind="stable")
        index = self.rivals.trials.index.numpy()[error.trials]
        return {float(index[k]): float(share[k]) for k in order}

    def needed(self, key: ModelKey) -> tuple[float, ...]:
        """Return the trials without which the data do not point to some effects."""
        return needed_trials(self.rivals, key)

    def p_value(self, key: ModelKey) -> float:
        """Return NaN: of a sample nobody asks."""
        return float("nan")

    def log_process(self, key: ModelKey) -> float:
        """Return -inf: of a sample nobody asks."""
        return -float("inf")
