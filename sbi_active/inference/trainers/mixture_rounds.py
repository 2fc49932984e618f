"""Training of a mixture density network in the place of sbi's training loop."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from sbi.inference.trainers._contracts import LossArgs, TrainConfig
from torch import Tensor
from torch.utils.data import DataLoader

from sbi_active.inference.networks.mixture_density import (
    MixtureDensity,
    TrainingRecord,
    train_mixture_density,
)
from sbi_active.inference.networks.mixture_network import MixtureDensityNetwork
from sbi_active.inference.sampling.adam import Adam
from sbi_active.inference.trainers.action_rounds import NEVER, ActionRounds


class MixtureRounds(ActionRounds):
    """Rounds whose default estimator is a :class:`.MixtureDensity`.

    With actions it is trained by :func:`.train_mixture_density`: sbi's loop takes
    several times as long on a network this small.
    """

    _settings = MixtureDensity
    _sbi_name = "density_estimator"
    _action_estimator: Any
    _fused = False  # whether Adam is one kernel

    @abstractmethod
    def _train_mixture(self, config: TrainConfig) -> TrainingRecord:
        """Train the network on this round's rows."""

    def _training_defaults(self, given: dict[str, Any]) -> dict[str, Any]:
        details = self._action_estimator.details
        return {
            "training_batch_size": details.batch_size,
            "learning_rate": details.learning_rate,
            "stop_after_epochs": NEVER,
        }

    def _run_training_loop(
        self,
        train_loader: DataLoader,
        val_loader: DataLoader,
        train_config: TrainConfig,
        loss_args: LossArgs | None = None,
        summarization_kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Train; for :class:`MixtureDensity` with actions, by the lean loop."""
        trainer: Any = self
        if not (self.has_actions and self._has_settings):
            return self._sbi._run_training_loop(
                train_loader, val_loader, train_config, loss_args, summarization_kwargs
            )
        self._neural_net.to(self._device)
        record = self._train_mixture(train_config)
        # What sbi's own loop would write.
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
        return self._neural_net

    def _trained(
        self,
        network: MixtureDensityNetwork,
        config: TrainConfig,
        theta: Tensor,
        condition: Tensor,
        **rows: Any,
    ) -> TrainingRecord:
        """Train a network, see :func:`.train_mixture_density`.

        The optimizer is the one so far where training is resumed.
        """
        if not config.resume_training:
            rate = config.learning_rate
            self.optimizer = Adam(network.parameters(), rate=rate, fused=self._fused)
        settings, size = self._action_estimator, config.training_batch_size
        steps, patience = len(rows["train_rows"]) // size, config.stop_after_epochs
        most = max(steps, 1) * config.max_num_epochs
        return train_mixture_density(
            *(network, self.optimizer, theta, condition),
            num_iterations=min(settings.num_iterations, most),
            batch_size=size,
            clip_max_norm=config.clip_max_norm,
            anneal=settings.details.anneal,
            patience=None if patience == NEVER else patience,
            **rows,
        )

    def _round_rows(self) -> tuple[Tensor, Tensor]:
        """Return this round's rows as sbi's trainer sees them, on the device."""
        trainer: Any = self
        theta, x, _ = trainer.get_simulations(self._round)
        return theta.to(self._device), x.to(self._device)
