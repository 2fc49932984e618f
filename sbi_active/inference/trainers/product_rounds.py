"""Updates of a belief by a learned likelihood or ratio of each trial."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.beliefs.weighted import KernelBelief
from sbi_active.inference.models.factors import (
    ActionFactor,
    Product,
    TrainedRegion,
    sample_product,
    widened,
)
from sbi_active.inference.rounds.rows import Observation, require_whole, rows_of
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.trainers.action_rounds import ActionRounds
from sbi_active.inference.trainers.base import Told, is_finite_somewhere
from sbi_active.seeding import derive_seed, forked_generators

SAMPLERS = ("importance", "kde")
#: Shares of the budget by stage, by what they begin at: this round's network, the
#: belief before, or the prior.
STAGES = {"network": (1.0,), "belief": (0.4, 0.6), "prior": (0.15, 0.15, 0.2, 0.5)}


class ProductRounds(ActionRounds):
    r"""Rounds of a method that learns a factor of each trial's likelihood.

    The belief is the original prior times the product over the history, in which the
    latest network gives the factor of every trial, within the region of its training
    rows:

    .. math::
        b_r(\theta) \propto p(\theta)\, 1[\theta \in R_r]
        \prod_{k \le r} q_r(x_k | \theta, \xi_k).

    ``update`` without a simulator gives that product under this round's network. With
    one, further parameters are drawn around it, more widely, and simulated at the
    executed actions alone, and a network trained on those rows gives the product
    again. Without a network of this round that begins at the belief before, and takes
    two stages or, from the prior, four; the options' ``num_histories`` is their sum.

    Args:
        args: Arguments of :class:`.ActionRounds`.
        posterior: Sampling method for the belief: "importance", tempered importance
            sampling; or "kde", the paper's: draws of the belief before times the last
            trial's factor, as a kernel density estimate.
        kwargs: Arguments of :class:`.ActionRounds` by name.

    References:
        Papamakarios, Sterratt & Murray, AISTATS 2019 (likelihoods need no correction
        for where theta was drawn); Deistler, Goncalves & Macke, NeurIPS 2022 (keeping
        to where a network was trained).
    """

    _factor: ClassVar[type[ActionFactor]]

    def __init__(self, *args: Any, posterior: str, **kwargs: Any) -> None:
        known = ", ".join(map(repr, SAMPLERS))
        advice = f"posterior among {known}", repr(posterior), "choose one of these"
        require(posterior in SAMPLERS, *advice)
        super().__init__(*args, **kwargs)
        self._sampler = posterior

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        exclude_invalid_x: bool | None = None,
        from_round: int = 0,
        algorithm: str | None = None,
        data_device: str | None = None,
        *,
        action: Tensor | None = None,
        belief: Distribution | None = None,
    ) -> Self:
        """Store simulations for training.

        Without ``action`` this is sbi's method. With it, the rows belong to the round
        of ``belief``; the same belief appended again continues that round.

        Args:
            theta: Parameters, shape (n, theta_dim), drawn from the belief.
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            exclude_invalid_x: Whether to drop rows without a measurement. With actions,
                None keeps them for this library's networks, which learn their
                probability, and drops them for sbi's, with a warning.
            from_round: Round number, as in sbi; without meaning where there are
                actions.
            algorithm: Algorithm name, as in sbi; None is sbi's.
            data_device: Device that keeps the rows.
            action: Actions, shape (n, action_dim), or (action_dim,) for all rows.
            belief: The distribution of theta in this round; None is the current one.

        Raises:
            ValueError: If rounds with and without action mix, shapes do not fit, theta
                leaves the prior's support, or an outcome is observed in part.
        """
        if not self._is_round(action, belief):
            named = {} if algorithm is None else {"algorithm": algorithm}
            return self._sbi.append_simulations(
                theta,
                x,
                exclude_invalid_x=bool(exclude_invalid_x),
                from_round=from_round,
                data_device=data_device,
                **named,
            )
        assert action is not None
        if self._has_settings and not exclude_invalid_x:
            require_whole(x)
        return self._append_round(
            theta, x, action, belief, exclude_invalid_x, data_device
        )

    def _model(self, estimator: Any, *arguments: Any) -> ActionFactor:
        assert self._outcome_shape is not None
        assert self._action_dim is not None
        return self._factor(
            estimator, self._round_belief, self._outcome_shape, self._action_dim
        )

    def _infer(self, told: Told) -> Belief:
        require_whole(torch.stack([trial.x for trial in told.trials]))
        seed = told.seed()
        if told.simulator is None:
            self._require_trained()
        belief: Belief | None = None
        if self._may_ask_network(told) and self._trained_round is not None:
            belief = self._product(told, seed)
        if told.simulator is not None:
            # Rounds and belief stay as they are, whatever is appended meanwhile.
            aside = object.__new__(type(self))
            vars(aside).update(vars(self))
            if told.afresh:
                aside._belief = None
            belief = aside._refined(told, belief, seed)
        assert belief is not None
        return belief

    def _refined(self, told: Told, start: Belief | None, seed: int) -> Belief:
        """Simulate the executed actions where the belief is, and learn that."""
        trials, settings = told.trials, told.settings
        assert told.simulator is not None
        belief: Any = self.belief if start is None else start
        begin = "network" if start is not None else "belief"
        begin = "prior" if belief is self._prior else begin
        action = torch.stack([t.action for t in trials])
        num_simulations = num_missing = 0
        for stage, share in enumerate(STAGES[begin]):
            num = int(share * settings.num_histories)
            own = derive_seed(seed, "stage", stage)
            theta = self._places(belief, num, own).repeat_interleave(len(trials), 0)
            rows = rows_of(
                *(told.simulator, theta, action.repeat(num, 1), derive_seed(own, "x")),
                settings.workers,
            )
            assert rows is not None
            num_simulations += len(rows)
            num_missing += rows.counts["missing"]
            known = rows.without_missing()
            self.append_simulations(
                known.theta, known.x, action=known.action, belief=belief
            )
            with forked_generators(own, "train"):
                self.train()
            belief = self._product(told, derive_seed(own, "product"))
        belief.diagnostics = belief.diagnostics.extended(
            num_simulations=num_simulations, num_missing=num_missing
        )
        return belief

    def _places(self, belief: Distribution, num: int, seed: int) -> Tensor:
        """Return parameters to simulate around a belief, shape (num, theta_dim)."""
        prior = require_support(self._prior)
        with forked_generators(seed, "theta"):
            theta = belief.sample(torch.Size([num]))
        if belief is prior:
            return theta
        rng = np.random.default_rng(derive_seed(seed, "wider"))
        coordinates = PriorCoordinates(prior, rng)
        z = widened(coordinates.to_z(theta), num, coordinates, rng)
        return coordinates.to_theta(z)

    def _product(
        self, told: Told, seed: int, *, num_kernels: int = 2_000, num_hints: int = 1_000
    ) -> Belief:
        """Return the belief under this round's network."""
        prior, previous = require_support(self._prior), self._round_belief
        assert previous is not None
        rng = np.random.default_rng(derive_seed(seed, "product"))
        coordinates = PriorCoordinates(prior, rng)
        region, hint = None, None
        if previous is not prior:
            rows = self._round_parameters()
            region = TrainedRegion.of(coordinates.to_z(rows), rng)
            hint = rows[rng.permutation(len(rows))[:num_hints]]
        chained = self._sampler == "kde"
        self._require_trained()
        learned = self._model(deepcopy(self._neural_net))
        used = told.trials[-1:] if chained else told.trials
        counted = [t for t in used if _says_something(learned, t, prior)]
        before = previous if chained and previous is not prior else None
        product = Product(coordinates, learned, counted, region, before)
        belief = sample_product(product, hint, rng, told.settings)
        sampled: Belief = belief
        if chained:
            with forked_generators(seed, "kernels"):
                draws = belief.sample(torch.Size([num_kernels]))
            sampled = KernelBelief(prior, draws)
        num_lost = len(used) - len(counted)
        if num_lost:
            sampled.diagnostics = sampled.diagnostics.warned(
                f"SA113 {num_lost} trials are left out, at which the network's "
                "density is finite nowhere: a measurement is wrong, or the simulator "
                "lacks much"
            )
        return sampled

    def _round_parameters(self) -> Tensor:
        """Return the parameters of this round's rows, shape (n, theta_dim)."""
        theta, _, _ = self.get_simulations()
        return theta[:, : require_support(self._prior).event_shape[-1]].cpu()


def _says_something(
    learned: ActionFactor, trial: Observation, prior: Distribution
) -> bool:
    """Return whether the factor of a trial is finite anywhere."""

    def log_factor(theta: Tensor) -> Tensor:
        x = trial.x.expand(len(theta), *trial.x.shape)
        return learned.log_factor(theta, x, trial.action.expand(len(theta), -1))

    return is_finite_somewhere(prior, log_factor)
