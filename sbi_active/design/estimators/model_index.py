"""The information about which of several rival models is right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
    Sampler,
)
from sbi_active.design.estimators.densities import (
    MOST_NUMBERS,
    NUM_FOLDS,
    by_pattern,
    class_members,
    cross_fit,
    noise_members,
)
from sbi_active.expected import require
from sbi_active.seeding import derive_seed


class RivalPredictive(Protocol):
    """A rival model: how probable it is, and what it predicts."""

    @property
    def probability(self) -> float:
        """Posterior probability, those of all rivals adding up to one."""
        ...

    def predict(
        self, action: Tensor, num_samples: int, seed: int
    ) -> Tensor | tuple[Tensor, Tensor, Tensor]:
        """Draw from the posterior predictive, parameters and noise included.

        A model that knows what its noise adds to a draw returns the outcomes without
        noise behind the draws, and the standard deviations of the noise in them, as
        well. A posterior draw that is used again has the same outcome without noise.
        The predictive density is then a mixture of the noise's, sharper than any
        density fitted to the outcomes alone; all rivals have to know theirs.

        Args:
            action: One action, shape (action_dim,).
            num_samples: Number of draws n.
            seed: Seed of the draws; the same for all actions and models.

        Returns:
            Shape (n, *x_shape), NaN where there is no measurement; each of the three,
            if there are these.
        """
        ...


class RivalSampler(Sampler):
    """Draw outcomes of rival models at candidates, as many of each model.

    The parameter is the index of the model, shape (n, 1), in turn 0, 1, ..., K - 1.

    Args:
        rivals: Models.
        seed: Seed of all draws.

    Attributes:
        probability: Probability of the models, shape (K,), float64.

    Raises:
        ValueError: If there are fewer than two rivals, or their probabilities are not
            positive or do not add up to one.
    """

    def __init__(self, rivals: Sequence[RivalPredictive], seed: int) -> None:
        values = [float(rival.probability) for rival in rivals]
        probability = torch.tensor(values, dtype=torch.float64)
        total = float(probability.sum())
        are_right = len(values) > 1 and min(values) >= 0 and abs(total - 1) <= 1e-3
        expected = "two or more rivals of probabilities >= 0 that add up to 1"
        require(are_right, expected, values, "normalize them")
        # a rival of no probability has no part in the information
        self.rivals = [r for r, p in zip(rivals, values, strict=True) if p > 0]
        self.probability = probability[probability > 0] / total
        self.seed = seed

    def draw(self, num_samples: int, action: Tensor) -> CandidateSimulations:
        """Draw outcomes.

        Args:
            num_samples: Number of outcomes of a candidate; rounded to an even number of
                each model.
            action: Candidates, shape (a, action_dim).

        Raises:
            ValueError: If a rival returns another number of rows or another shape.
        """
        self._num_waves += 1
        seed = derive_seed(self.seed, "rivals", self._num_waves)
        num_rivals = len(self.rivals)
        each = 2 * max(1, num_samples // (2 * num_rivals))
        rows = []
        for own in action:
            drawn = [self._predict(k, own, each, seed) for k in range(num_rivals)]
            shapes = [tuple(part.shape) for parts in drawn for part in parts]
            are_alike = len({*shapes}) == 1 and shapes[0][:1] == (each,)
            expected = f"{each} outcomes, means and deviations of one shape a rival"
            require(are_alike, expected, shapes, "return a row of the same x a draw")
            each_kind = zip(*drawn, strict=False)  # those that all rivals have
            rows.append(torch.stack([torch.stack(kind, 1) for kind in each_kind]))
        every = torch.stack(rows, 1).flatten(2, 3)
        # kernels as narrow as the noise need what a float loses of a large number
        if len(every) == 1 or every[0, 0, 0].numel() > MOST_NUMBERS:
            every = every.float()
        self.num_drawn += len(action) * every.shape[2]
        index = torch.arange(num_rivals).repeat(each)[:, None]
        x, *noise = every if every.ndim > 3 else every[..., None]
        mean, sd = noise or (None, None)
        return CandidateSimulations(index, action, x, mean, sd=sd)

    def _predict(self, k: int, action: Tensor, num: int, seed: int) -> list[Tensor]:
        """Return outcomes, and where the rival knows them means and deviations."""
        found = self.rivals[k].predict(action, num, derive_seed(seed, k))
        parts = found if isinstance(found, tuple) else (found,)
        return [torch.as_tensor(part).double() for part in parts]


class ModelIndexGain(InformationGainEstimator):
    r"""Variational bound for the index k of the model.

    .. math::
        I(k; x | \xi) \ge \sum_k p_k\, E_{x \sim p_k(x | \xi)}
        \left[ \log q(k | x, \xi) - \log p_k \right], \qquad
        q(k | x, \xi) \propto p_k\, P_k(v)\, f_k(x | v)^{\beta}

    with v the numbers of x that are present, P_k(v) their share among the model's
    draws, and f_k a density of them: a mixture of normals, of a few discriminating
    numbers where x is long; :math:`\beta \le 1` tempers it. Where the
    rivals know their noise and x is short, kernels at the outcomes without noise are as
    narrow as the noise. All are fitted to three quarters of the draws and score the
    rest, in turn (a posterior draw that is used twice stands in one of them);
    the kind and :math:`\beta` of a quarter are chosen on the others.
    It is a lower bound for any q, and the information is at most the entropy of p.

    Args:
        probability: :math:`p_k`, shape (K,).
        few: Outcomes of one pattern and model whose numbers are not used.

    References:
        Barber & Agakov, NeurIPS 2003; Box & Hill, Technometrics 1967 (design for
        discrimination).
    """

    bound: Bound = "lower"
    needs_model = False

    def __init__(self, probability: Tensor, *, few: int = 16) -> None:
        self.probability, self.few = probability.double(), few
        self.fewest = 4 * few

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution | None
    ) -> Tensor:
        index = simulations.theta[:, 0].long()
        # as many draws of each model: weights restore the probabilities
        weight = self.probability[index] * len(self.probability)
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        block = _blocks(simulations, index, len(self.probability))
        known = [p for p in (simulations.mean, simulations.sd) if p is not None]
        for a, rows, columns, x in by_pattern(simulations, self.fewest):
            noise = [p[a].flatten(1)[rows][:, columns].double() for p in known]
            given = x, noise, rows, simulations.counted[a], index, block
            gain[a, rows] = weight[rows] * self._score(*given)
        return gain

    def _score(
        self,
        x: Tensor,
        noise: list[Tensor],
        rows: Tensor,
        counted: Tensor,
        index: Tensor,
        block: Tensor,
        *,
        powers: tuple[float, ...] = (1.0, 0.5),
    ) -> Tensor:
        """Held-out log q(k | x) - log p_k of the rows of one pattern, shape (rows,).

        The powers of a density are against too much confidence. Rows of a block (n,)
        share a fold.
        """
        log_p, own, fold = self.probability.log(), index[rows], block % NUM_FOLDS
        num_models = len(log_p)
        # the same members in every fold, or they could not be compared
        each = torch.zeros(num_models, NUM_FOLDS).long()
        each.index_put_((own, fold[rows]), torch.ones_like(own), accumulate=True)
        enough = (each.sum(1) - each.amax(1)) >= self.few

        def score(train: Tensor, test: Tensor) -> Tensor:
            # log share of the pattern among each model's draws outside the fold
            used = counted & torch.isin(fold, fold[rows[train]])
            hits = torch.bincount(own[train], minlength=num_models) + 0.5
            share = hits / (torch.bincount(index[used], minlength=num_models) + 1)
            log_prior = log_p + share.log()
            members = class_members(x[train], own[train], enough)
            if len(noise) == 2:
                center, width = (part[train] for part in noise)
                members += noise_members(center, width, own[train], enough)
            scores = []
            for member in members:
                log_f = member(x[test])
                for power in powers:
                    log_q = (log_prior + power * log_f).log_softmax(1)
                    log_q = log_q[torch.arange(len(test)), own[test]]
                    scores.append(log_q - log_p[own[test]])
            return torch.stack(scores)

        return cross_fit(score, block[rows], log_p.exp()[own])


def _blocks(
    simulations: CandidateSimulations, index: Tensor, num_models: int
) -> Tensor:
    """Return numbers of blocks, shape (n,): draws that share a fold.

    Where outcomes without noise are known, those are one model's that share them.
    """
    if simulations.mean is None:
        return torch.arange(len(index)) // num_models
    mean = simulations.mean.transpose(0, 1).flatten(1)
    block = torch.empty(len(index)).long()
    for k in range(num_models):
        own = index == k
        distinct, block[own] = mean[own].unique(dim=0, return_inverse=True)
        if len(distinct) < 2 * NUM_FOLDS:  # a fold would have none of the model
            block[own] = torch.arange(int(own.sum()))
    return block
