"""Simulate candidates and estimate what they tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain import (
    CandidateSimulations,
    InformationGainEstimator,
    RivalSampler,
)
from sbi_active.information_gain.base import Bound
from sbi_active.information_gain.candidates import CandidateSampler
from sbi_active.information_gain.estimators.automatic import (
    choose_estimator,
    disagreements,
)
from sbi_active.information_gain.joint import JointLikelihood, conditional_gain
from sbi_active.threads import single_thread


class GainEvaluator:
    """Estimates of the information gain of candidates, on simulations of its sampler.

    Args:
        sampler: Draws outcomes.
        estimator: Estimator of the information; None chooses one by what the first
            simulations show.
        model: Model that the estimator needs.
        belief: Belief over the parameters.

    Attributes:
        notes: Notes on failed checks of the estimator, or why others were not taken.
        num_others: Actions whose outcomes will be known as well.
        replicates: Whether every row is simulated twice; None before the first.
    """

    def __init__(
        self,
        sampler: CandidateSampler | RivalSampler,
        estimator: InformationGainEstimator | None,
        model: Any,
        belief: Distribution | None,
    ) -> None:
        self.sampler, self.model, self.belief = sampler, model, belief
        self.notes: list[str] = []
        self.replicates: bool | None = None
        self._chosen = estimator
        self.num_others = len(getattr(sampler, "others", ()))

    @property
    def estimator(self) -> InformationGainEstimator:
        """The estimator given, or the one chosen by the first simulations."""
        assert self._chosen is not None
        return self._chosen

    @property
    def is_summarized(self) -> bool:
        """Whether summaries stand for outcomes."""
        return getattr(self.sampler, "summaries", None) is not None

    @property
    def bound(self) -> Bound:
        """Side of the information that the estimates lie on.

        A difference of two bounds is none.
        """
        return "none" if self.num_others else self.estimator.bound_on(self.model)

    def add(self, action: Tensor) -> Tensor:
        """Add candidates (k, action_dim); return their indices, shape (k,)."""
        num = len(self.sampler.action)
        self.sampler.action = torch.cat([self.sampler.action, action])
        return num + torch.arange(len(action))

    def draw(self, num_samples: int, index: Tensor) -> CandidateSimulations:
        """Simulate candidates (k,); the first call settles the estimator."""
        if self.replicates is not None:
            return self.sampler.draw(num_samples, index, replicates=self.replicates)
        replicates = self._chosen is None or self._chosen.needs_noise
        first = self.sampler.draw(num_samples, index, replicates=replicates)
        if self._chosen is None:
            model: Any = self.model
            if self.num_others and model is not None:
                model = JointLikelihood(model, self.sampler.action.shape[1])
            self._chosen, self.notes = choose_estimator(model, first)
            own = self.sampler
            if (
                isinstance(own, CandidateSampler)
                and own.summaries is not None
                and self._chosen.needs_model  # which was learned from whole outcomes
            ):
                own.summaries = None
                own.rewind()
                first = own.draw(num_samples, index, replicates=replicates)
        else:
            self.notes = self._chosen.problems(first)
        self.replicates = first.replicate is not None
        return first

    def __call__(self, simulations: CandidateSimulations) -> Tensor:
        """Return contributions, shape (a, n), nats."""
        with single_thread():
            if not self.num_others:
                return self.estimator(self.model, simulations, self.belief)
            return conditional_gain(
                self.estimator,
                self.model,
                simulations,
                self.belief,
                action_dim=self.sampler.action.shape[1],
            )

    def disagreements(
        self, simulations: CandidateSimulations, gain: Tensor
    ) -> Sequence[str]:
        """Return the disagreements of other estimators, see :func:`disagreements`."""
        if self.num_others:
            return self.estimator.cautions(gain)
        with single_thread():
            model = None if self.is_summarized else self.model
            return disagreements(self.estimator, model, simulations, self.belief, gain)
