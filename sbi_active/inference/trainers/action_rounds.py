"""Rounds of simulations with actions, as a part of any of sbi's trainers."""

from __future__ import annotations

from typing import Any

import torch
from sbi.inference.trainers._contracts import StartIndexContext, TrainConfig
from sbi.sbi_types import Tracker
from sbi.utils.sbiutils import mask_sims_from_prior
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.inference.beliefs.belief import require_support
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.training import TrainingBudget, TrainingRecord
from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack
from sbi_active.inference.rounds.rows import (
    Observation,
    RoundRows,
    check_proposal,
    round_rows,
)
from sbi_active.inference.rounds.tracking import SilentTracker

__all__ = ["ActionRounds"]


class ActionRounds:
    r"""Rows by round of the belief they were drawn from, and the trials in between.

    To be mixed in before a trainer of sbi's. A round is that of Algorithm 1: this
    round's rows, a network built anew, plain maximum likelihood.

    Args:
        kwargs: Of sbi's trainer.

    Attributes:
        trials: Real trials, each of which ended a round.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331.
    """

    # Of sbi's trainers.
    _prior: Distribution | None
    _device: str
    _round: int
    _theta_roundwise: list[Tensor]
    _x_roundwise: list[Tensor]
    _prior_masks: list[Tensor]
    _data_round_index: list[int]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._belief: Distribution | None = None
        self._round_belief: Distribution | None = None
        self._action_dim: int | None = None
        self._outcome_shape: torch.Size | None = None
        self._trained_round: int | None = None
        self._epoch_limit: int | None = None
        self._patience: int | None = None
        self.trials: list[Observation] = []

    @property
    def belief(self) -> Distribution | None:
        """The current belief over parameters; the prior before any trial."""
        return self._prior if self._belief is None else self._belief

    @property
    def has_actions(self) -> bool:
        """Whether the rounds so far have actions."""
        return self._action_dim is not None

    def arrange(self, theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows to simulate in a round: the draws as they are.

        Args:
            theta: Draws from the belief, shape (n, theta_dim).
            action: Draws from the action space, shape (n, action_dim).
        """
        return theta, action

    @property
    def _keeps_invalid(self) -> bool:
        """Whether the estimator of a round takes outcomes without a measurement."""
        return False

    def _stored(self, rows: RoundRows) -> tuple[Tensor, Tensor]:
        """Return the parameters and outcomes that sbi's trainer sees."""
        return rows.theta, pack(rows.x, rows.action)

    def _is_round(self, action: Tensor | None, belief: Distribution | None) -> bool:
        """Return whether rows have actions, or raise where they must and do not."""
        if action is not None:
            if self._data_round_index and not self.has_actions:
                name = type(self).__name__
                raise ValueError(
                    "expected rounds without action, since earlier rounds of this "
                    f"trainer have none; got action=; do start a new {name}(prior) for "
                    "rounds with actions"
                )
            return True
        if self.has_actions or belief is not None:
            raise ValueError(
                "expected action=, since "
                + (
                    "belief= was given"
                    if not self.has_actions
                    else "earlier rounds of this trainer have actions"
                )
                + "; got none; do pass the action of each row, or start a new "
                "trainer for rounds without actions"
            )
        return False

    def _append_round(
        self,
        theta: Tensor,
        x: Tensor,
        action: Tensor,
        belief: Distribution | None,
        exclude_invalid_x: bool | None,
        data_device: str | None,
        proposal: Any = None,
    ) -> Self:
        belief = self.belief if belief is None else belief
        check_proposal(proposal, belief)
        rows = round_rows(
            theta,
            x,
            action,
            prior=require_support(self._prior),
            x_shape=self._outcome_shape,
            action_dim=self._action_dim,
            exclude_invalid=(
                not self._keeps_invalid
                if exclude_invalid_x is None
                else exclude_invalid_x
            ),
            may_be_invalid=bool(self.trials),
        )
        self._action_dim = rows.action.shape[1]
        self._outcome_shape = rows.x.shape[1:]
        current = max(self._data_round_index, default=-1)
        if belief is not self._round_belief:
            self._round_belief = belief
            current += 1
        self._belief = belief
        self._trained_round = None
        device = self._device if data_device is None else data_device
        parameters, outcomes = self._stored(rows)
        self._theta_roundwise.append(parameters.to(device))
        self._x_roundwise.append(outcomes.to(device))
        self._prior_masks.append(mask_sims_from_prior(current, len(rows.theta)))
        self._data_round_index.append(current)
        return self

    def _get_start_index(self, context: StartIndexContext) -> int:
        if not self.has_actions:
            return super()._get_start_index(context)  # pyright: ignore
        self._round = max(self._data_round_index)
        return self._round  # this round's rows only

    def _require_trained(self) -> None:
        if self._trained_round is None:
            raise RuntimeError(
                "expected a network trained on this round's simulations; got new rows "
                "since the last train(); do call train() first"
            )

    def _require_belief_network(self) -> None:
        if self._trained_round is None:
            raise RuntimeError(
                "expected a network trained under the current belief; got none since "
                "the last update() or append_simulations(); do append simulations of "
                "the belief with action= and train() first"
            )

    def _training_budget(
        self, settings: MixtureDensity, train_config: TrainConfig, num_rows: int
    ) -> TrainingBudget:
        """Return the budget of this library's own training on so many rows."""
        num_iterations = settings.num_iterations
        if self._epoch_limit is not None:
            steps = max(num_rows // train_config.training_batch_size, 1)
            num_iterations = min(num_iterations, steps * self._epoch_limit)
        return TrainingBudget(
            num_iterations=num_iterations,
            batch_size=train_config.training_batch_size,
            clip_max_norm=train_config.clip_max_norm,
            anneal=settings.anneal,
            patience=self._patience,
        )

    def _summarize_training(
        self, record: TrainingRecord, train_config: TrainConfig
    ) -> None:
        """Write what sbi's own training loop would write."""
        trainer: Any = self
        trainer._best_val_loss = best = min(record.validation_loss)
        summary = trainer._summary
        summary["training_loss"] += record.training_loss
        summary["validation_loss"] += record.validation_loss
        summary["epoch_durations_sec"] += record.seconds
        summary["epochs_trained"].append(len(record.seconds))
        summary["best_validation_loss"].append(best)
        trainer._summarize(round_=self._round)
        if train_config.show_train_summary:
            print(trainer._describe_round(self._round, summary))

    def _require_same_rows(self, resume_training: bool) -> None:
        if resume_training and self._trained_round != max(self._data_round_index):
            raise ValueError(
                "expected resume_training after train() on the same rows; got rows "
                "appended since; do train() without resume_training"
            )

    def _observation(self, x_o: Tensor, action: Tensor) -> Observation:
        """Return the checked trial."""
        x = torch.as_tensor(x_o)
        shape = self._outcome_shape
        if shape is None:  # no simulations yet: the first trial says
            shape = self.trials[0].x.shape if self.trials else x.shape or (1,)
        rows = outcome_rows(x, shape)
        if len(rows) != 1:
            raise ValueError(
                f"expected one outcome; got {len(rows)} rows; do update with one trial "
                "at a time"
            )
        return Observation(
            action_rows(action, self._action_dim, num_rows=1)[0], rows[0]
        )

    def _default_tracker(self) -> Tracker:
        return SilentTracker()
