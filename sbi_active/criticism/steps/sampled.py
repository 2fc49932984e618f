"""Evidence of the models by samples of their posteriors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import (
    OUTLIER,
    UNEXPLAINED,
    Detection,
    Evidence,
    ModelKey,
)
from sbi_active.criticism.steps.combinations import grow
from sbi_active.criticism.steps.detection import REFUTED, detect
from sbi_active.criticism.steps.influence import needed_trials

Array = NDArray[Any]


@dataclass
class Sampled:
    """Models of any simulator, each fitted and sampled once it is asked for.

    Attributes:
        rivals: The models.
        equivalent: Groups of effects that no permitted action separates.
    """

    rivals: RivalSet
    equivalent: Sequence[frozenset[str]] = ()

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
        return grow(self.rivals, dict(singles), dict(prior))

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
