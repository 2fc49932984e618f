"""The information about which of several rival models is right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.class_density import class_members
from sbi_active.information_gain.cross_fitting import cross_fit, patterns_of_numbers
from sbi_active.seeding import derive_seed

__all__ = ["ModelIndexGain", "RivalPredictive", "RivalSampler"]

FEW = 16  # outcomes of one pattern and model whose numbers are not used


class RivalPredictive(Protocol):
    """A rival model: how probable it is, and what it predicts."""

    @property
    def probability(self) -> float:
        """Posterior probability, those of all rivals adding up to one."""
        ...

    def predict(self, action: Tensor, num_samples: int, seed: int) -> Tensor:
        """Draw from the posterior predictive, parameters and noise included.

        Args:
            action: One action, shape (action_dim,).
            num_samples: n.
            seed: Of the draws; the same for all actions and models.

        Returns:
            Shape (n, *x_shape), NaN where there is no measurement.
        """
        ...


class RivalSampler:
    """Draw outcomes of rival models at candidates, as many of each model.

    It stands in for :class:`~sbi_active.information_gain.candidates.CandidateSampler`:
    the parameter is the index of the model, shape (n, 1), in turn 0, 1, ..., K - 1.

    Args:
        rivals: Models.
        action: Candidates, shape (a, action_dim).
        seed: Of everything drawn.

    Attributes:
        probability: Of the models, shape (K,), float64.
        declared: False: no noise is declared.
        num_drawn: Outcomes so far.
        num_missing: 0: rivals lose none.

    Raises:
        ValueError: If there are fewer than two rivals, or their probabilities are not
            positive or do not add up to one.
    """

    declared = False
    num_missing = 0

    def __init__(
        self, rivals: Sequence[RivalPredictive], action: Tensor, seed: int
    ) -> None:
        self.rivals, self.action, self.seed = list(rivals), action, seed
        values = [float(rival.probability) for rival in self.rivals]
        self.probability = torch.tensor(values, dtype=torch.float64)
        total = float(self.probability.sum())
        if len(values) < 2 or min(values) < 0 or abs(total - 1) > 1e-3:
            raise ValueError(
                "expected two or more rivals whose probabilities are not negative and "
                f"add up to 1; got {values}; do normalize them"
            )
        # a rival of no probability has no part in the information
        self.rivals = [r for r, p in zip(self.rivals, values, strict=True) if p > 0]
        self.probability = self.probability[self.probability > 0] / total
        self.num_drawn = 0
        self._num_waves = 0

    def draw(
        self, num_samples: int, candidates: Tensor, *, replicates: bool
    ) -> CandidateSimulations:
        """Draw outcomes.

        Args:
            num_samples: Of a candidate; rounded to an even number of each model.
            candidates: Indices, shape (k,).
            replicates: Of no use here.

        Raises:
            ValueError: If a rival returns another number of rows or another shape.
        """
        self._num_waves += 1
        seed = derive_seed(self.seed, "rivals", self._num_waves)
        each = 2 * max(1, num_samples // (2 * len(self)))
        rows = []
        for action in self.action[candidates]:
            drawn = [self._predict(k, action, each, seed) for k in range(len(self))]
            if len({part.shape for part in drawn}) > 1:
                raise ValueError(
                    "expected outcomes of one shape from all rivals; got "
                    f"{[tuple(part.shape) for part in drawn]}; do predict the same x"
                )
            rows.append(torch.stack(drawn, 1).flatten(0, 1))
        self.num_drawn += len(rows) * len(rows[0])
        index = torch.arange(len(self)).repeat(each)[:, None]
        return CandidateSimulations(index, self.action[candidates], torch.stack(rows))

    def _predict(self, k: int, action: Tensor, num: int, seed: int) -> Tensor:
        x = torch.as_tensor(self.rivals[k].predict(action, num, derive_seed(seed, k)))
        if x.ndim == 0 or len(x) != num:
            raise ValueError(
                f"expected {num} outcomes from rival {k}; got shape {tuple(x.shape)}; "
                "do return one row a draw"
            )
        return (x[:, None] if x.ndim == 1 else x).float()

    def __len__(self) -> int:
        return len(self.rivals)


class ModelIndexGain(InformationGainEstimator):
    r"""Variational bound for the index k of the model.

    .. math::
        I(k; x | \xi) \ge \sum_k p_k\, E_{x \sim p_k(x | \xi)}
        \left[ \log q(k | x, \xi) - \log p_k \right], \qquad
        q(k | x, \xi) \propto p_k\, P_k(v)\, f_k(x | v)^{\beta}

    with v the numbers of x that are present, P_k(v) their share among the model's
    draws, and f_k a density of them: Gaussian (with one covariance or one a model) or
    by kernels, of a few discriminating numbers where x is long; :math:`\beta \le 1`
    tempers it. All are fitted to three quarters of the draws and score the rest, in
    turn; the kind and :math:`\beta` of a quarter are chosen on the others. It is a
    lower bound for any q, and the information is at most the entropy of p.

    Args:
        probability: :math:`p_k`, shape (K,).

    References:
        Barber & Agakov, NeurIPS 2003; Box & Hill, Technometrics 1967 (design for
        discrimination).
    """

    bound: Bound = "lower"
    needs_noise = False
    needs_model = False

    def __init__(self, probability: Tensor) -> None:
        self.probability = probability.double()

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution | None
    ) -> Tensor:
        index = simulations.theta[:, 0].long()
        num_models = len(self.probability)
        # as many draws of each model: weights restore the probabilities
        weight = self.probability[index] * num_models
        log_p = self.probability.log()
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        for a, counted in enumerate(simulations.counted):
            x = simulations.x[a].flatten(1).double()
            groups = patterns_of_numbers(x, counted, 4 * FEW)
            label = torch.zeros(len(x)).long()
            for g, (rows, _) in enumerate(groups):
                label[rows] = g
            for rows, columns in groups:
                inside = label == label[rows[0]]
                gain[a, rows] = weight[rows] * _score(
                    x[rows][:, columns], index, inside & counted, counted, rows, log_p
                )
        return gain


def _score(
    x: Tensor,
    index: Tensor,
    inside: Tensor,
    counted: Tensor,
    rows: Tensor,
    log_p: Tensor,
) -> Tensor:
    """Held-out log q(k | x) - log p_k of the rows of one pattern, shape (rows,)."""
    num_models = len(log_p)
    block = torch.arange(len(index)) // num_models
    own = index[rows]

    def log_shares(train: Tensor) -> Tensor:
        """Log share of the pattern among each model's draws outside the fold."""
        fold = set((block[rows[train]] % 4).tolist())
        used = counted & torch.tensor([int(b) % 4 in fold for b in block])
        hits = torch.bincount(index[used & inside], minlength=num_models) + 0.5
        return (hits / (torch.bincount(index[used], minlength=num_models) + 1)).log()

    def score(train: Tensor, test: Tensor) -> Tensor:
        log_prior = log_p + log_shares(train)
        count = torch.bincount(own[train], minlength=num_models)
        members = class_members(x[train], own[train], count >= FEW)
        scores = []
        for member in members:
            log_q = (log_prior + member(x[test])).log_softmax(1)
            scores.append(log_q[torch.arange(len(test)), own[test]] - log_p[own[test]])
        return torch.stack(scores)

    return cross_fit(score, block[rows], log_p.exp()[own])
