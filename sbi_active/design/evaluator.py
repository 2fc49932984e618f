"""Estimates of what candidates tell, by simulation."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.automatic import choose_estimator, disagreements
from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.estimators.model_index import RivalSampler
from sbi_active.design.outcomes import JointLikelihood, conditional_gain
from sbi_active.design.sampler import CandidateSampler
from sbi_active.threads import single_thread


class GainEvaluator:
    """Draws outcomes of candidates and estimates what these tell.

    Args:
        sampler: Sampler of the outcomes.
        estimator: Estimator of the information; None is chosen by the first
            simulations.
        model: Model that the estimator needs.
        belief: Distribution of the parameters; None for rivals.

    Attributes:
        notes: Notes on failed checks of the estimator, or why others were not taken.
        replicates: Whether every row is simulated twice; None before the first.
    """

    def __init__(
        self,
        sampler: CandidateSampler | RivalSampler,
        estimator: InformationGainEstimator | None,
        model: Any,
        belief: Distribution | None = None,
    ) -> None:
        self.sampler, self.model, self.belief = sampler, model, belief
        self._chosen = estimator
        self.num_others = len(sampler.others)
        self.notes: list[str] = []
        self.replicates: bool | None = None

    @property
    def estimator(self) -> InformationGainEstimator:
        """The estimator given, or the one chosen by the first simulations."""
        assert self._chosen is not None
        return self._chosen

    @property
    def bound(self) -> Bound:
        """Side of the information that the estimates lie on.

        A difference of two bounds is none.
        """
        return "none" if self.num_others else self.estimator.bound_on(self.model)

    def draw(
        self, num_samples: int, action: Tensor, *, halves: bool = False
    ) -> CandidateSimulations:
        """Simulate candidates (a, action_dim); the first call settles the estimator.

        Args:
            num_samples: Simulations of a candidate.
            action: Candidates.
            halves: Whether an estimate will rest on half of them.
        """
        sampler = self.sampler
        if self.replicates is not None:
            return sampler.draw(num_samples, action, replicates=self.replicates)
        replicates = self._chosen is None or self._chosen.needs_noise
        first = sampler.draw(num_samples, action, replicates=replicates)
        if self._chosen is not None:
            self.notes = self._chosen.problems(first)
        else:
            model: Any = self.model
            if self.num_others and model is not None:
                model = JointLikelihood(model, action.shape[1])
            num_rows = num_samples // 2 if halves else num_samples
            self._chosen, self.notes = choose_estimator(model, first, num_rows=num_rows)
            # A model was learned from whole outcomes.
            if sampler.summaries is not None and self._chosen.needs_model:
                sampler.summaries = None
                sampler.rewind()
                first = sampler.draw(num_samples, action, replicates=replicates)
        self.replicates = first.replicate is not None
        return first

    def __call__(self, simulations: CandidateSimulations) -> Tensor:
        """Return contributions, shape (a, n), nats."""
        given = self.model, simulations, self.belief
        with single_thread():
            if self.num_others:
                return conditional_gain(self.estimator, *given, self.num_others)
            return self.estimator(*given)

    def disagreements(
        self, simulations: CandidateSimulations, gain: Tensor
    ) -> list[str]:
        """Return the disagreements of other estimators, see :func:`.disagreements`."""
        if self.num_others:
            return self.estimator.cautions(gain)
        model = self.model if self.sampler.summaries is None else None
        with single_thread():
            return disagreements(self.estimator, model, simulations, self.belief, gain)
