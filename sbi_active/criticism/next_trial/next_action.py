"""The next action: the one whose outcome tells most about which rival is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.arrays import Array
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.next_trial.candidates import (
    PLAN,
    beyond_range,
    following,
    permitted_candidates,
    simulated,
)
from sbi_active.criticism.results import ModelKey, NextAction, Tracing
from sbi_active.criticism.steps.predictive import predict
from sbi_active.design.design import Design
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.seeding import derive_seed


class PredictedRival:
    """A rival of the closed loop, as the designer wants it.

    Args:
        rivals: The models.
        key: Key of this rival.
        probability: Probability of this rival, those of all rivals adding up to one.
        candidates: Candidates, all actions that will be asked for, shape (a,
            action_dim). They are predicted together, each as the next trial.
    """

    def __init__(
        self, rivals: RivalSet, key: ModelKey, probability: float, candidates: Tensor
    ) -> None:
        self.rivals, self.key, self.probability = rivals, key, probability
        self.candidates = candidates
        self._trials = following(rivals, candidates)
        self._draws: tuple[tuple[int, int], Tensor] | None = None

    def predict(self, action: Tensor, num_samples: int, seed: int) -> Tensor:
        """Return draws from the posterior predictive, shape (n, q).

        Args:
            action: One of the candidates, shape (action_dim,).
            num_samples: Number of draws n.
            seed: Seed of the draws.
        """
        return self._at(action, num_samples, seed)[0]

    def predict_mean(
        self, action: Tensor, num_samples: int, seed: int
    ) -> tuple[Tensor, Tensor]:
        """Return these draws without noise, and its standard deviations, (n, q).

        Args:
            action: One of the candidates, as in :meth:`predict`.
            num_samples: Number of draws n, as in :meth:`predict`.
            seed: Seed of the draws, as in :meth:`predict`.
        """
        _, mean, sd = self._at(action, num_samples, seed)
        return mean, sd

    def _at(self, action: Tensor, num_samples: int, seed: int) -> Tensor:
        if self._draws is None or self._draws[0] != (num_samples, seed):
            self._draws = (num_samples, seed), self._predict(num_samples, seed)
        same = (self.candidates == action.to(self.candidates)).all(-1)
        return self._draws[1][:, :, int(same.int().argmax())]

    def _predict(self, num_samples: int, seed: int) -> Tensor:
        """Return outcomes, means and deviations, shape (3, n, a, q).

        Outcomes are NaN where there is none.
        """
        prediction = predict(
            self.rivals,
            self._trials,
            key=self.key,
            num_draws=num_samples,
            seed=seed,
            scored=False,
        )
        trial = prediction.measurements.trial
        x = np.where(prediction.valid[:, trial], prediction.x, np.nan)
        every = np.stack([x, prediction.mean, prediction.sd])
        each = [np.flatnonzero(trial == t) for t in range(len(self._trials))]
        return torch.from_numpy(np.stack([every[:, :, at] for at in each], 2))


def choose_action(
    rivals: RivalSet, tracing: Tracing, actions: ActionSpace, *, outside: bool = True
) -> NextAction:
    r"""Return the action of the largest information about the model index.

    It is a lower bound on :math:`I(k; x | \xi)` from draws of each rival's posterior
    predictive, chosen on one half of them and reported on the other. Where it is below
    .02 nats for every permitted action, or some of the rivals are equivalent, actions
    beyond the permitted range are tried: one that separates them is named.

    If every model misses, rivals are weighted by their errors on left-out trials, since
    their probabilities are too sure. Their residuals are a part of their predictions.

    Args:
        rivals: The models.
        tracing: Tracing with their probabilities.
        actions: The permitted ones.
        outside: Whether to try others where these separate nothing.
    """
    candidates = permitted_candidates(rivals, actions)
    own, misfit = _Choosing(rivals, tracing), tracing.misfit
    shares = tracing.probabilities if misfit is None else misfit.weights
    named = [n for n, p in shares.items() if p > PLAN.negligible][: PLAN.max_rivals]
    gain, action = np.zeros(len(candidates)), None
    if len(named) > 1:
        p = np.array([shares[n] for n in named])
        action, gain = own.most_telling(named, p / p.sum(), candidates)
    found = NextAction(
        action=action,
        candidates=candidates.double().numpy(),
        information_gain=gain,
        separates=(*named,),
    )
    if len(named) < 2:
        return found
    groups = [g & {*named} for g in tracing.equivalent]
    if action is None:
        groups.append(frozenset(named))
    groups = [g for g in dict.fromkeys(groups) if len(g) > 1]
    found = replace(found, inseparable=(*groups,))
    if not outside or not groups:
        return found
    others = beyond_range(actions, candidates, limit=PLAN.max_outside, mirrored=True)
    return own.look_outside(found, simulated(rivals, others))


@dataclass(frozen=True)
class _Choosing:
    """Designs that tell rivals apart, by the models and the verdict on them."""

    rivals: RivalSet
    tracing: Tracing

    def most_telling(
        self, names: Sequence[str], p: Array, candidates: Tensor
    ) -> tuple[Array | None, Array]:
        """Return the best candidate, None if it tells nothing, and what each tells."""
        design = self.select(names, p, candidates)
        gain = design.expected_information_gain.clamp_min(0.0).numpy()
        told = gain[design.index]
        others = np.flatnonzero(gain >= PLAN.something)
        if told < PLAN.nothing and len(others):
            # The draws that chose it do not report: at some of them alone it tells
            # much.
            part = candidates[torch.from_numpy(others)]
            design = self.select(names, p, part, again=True)
            gain[others] = design.expected_information_gain.clamp_min(0.0).numpy()
            told = gain[others[design.index]]
        return (design.action.double().numpy() if told >= PLAN.nothing else None), gain

    def look_outside(self, found: NextAction, others: Tensor) -> NextAction:
        """Return the choice with an action that is not permitted, if one separates."""
        for group in found.inseparable if len(others) else ():
            names = [n for n in found.separates if n in group]
            design = self.select(names, np.full(len(names), 1 / len(names)), others)
            gain = float(design.expected_information_gain[design.index])
            error = float(design.standard_error[design.index])
            if gain - 2 * error >= PLAN.nothing and gain > found.outside_gain:
                found = replace(
                    found,
                    outside=design.action.double().numpy(),
                    outside_separates=(*names,),
                    outside_gain=gain,
                )
        return found

    def select(
        self, names: Sequence[str], p: Array, candidates: Tensor, *, again: bool = False
    ) -> Design:
        """Return the design that tells rivals apart, of some probabilities."""
        evidences, rivals = self.tracing.evidences, self.rivals
        models = [
            PredictedRival(rivals, evidences[name].key, float(share), candidates)
            for name, share in zip(names, p, strict=True)
        ]
        designer = InformationGainDesigner(
            DiscreteActions(candidates),
            num_samples=PLAN.samples * len(models),
            eliminate=False,  # a part of the samples would be too few for densities
        )
        seed = derive_seed(rivals.seed, "next action", *names, *["again"] * again)
        return designer.select(models, target="model", seed=seed)
