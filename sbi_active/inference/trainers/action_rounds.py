"""Rounds of simulations with actions, as a part of any of sbi's trainers."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, ClassVar

import cloudpickle
import torch
from sbi.inference.trainers._contracts import (
    LossArgs,
    StartIndexContext,
    TrainConfig,
)
from sbi.sbi_types import Tracker
from sbi.utils.sbiutils import mask_sims_from_prior
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import DataLoader
from typing_extensions import Self

from sbi_active.expected import require
from sbi_active.inference.networks.mixture_density import (
    Adam,
    MixtureDensity,
    train_network,
)
from sbi_active.inference.rounds.condition import pack
from sbi_active.inference.rounds.rows import check_proposal, require_whole
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.inference.trainers.signatures import extended, given_arguments
from sbi_active.simulation.outcomes import Simulations
from sbi_active.threads import single_thread


class SilentTracker:
    """Meets sbi's ``Tracker`` protocol and does nothing."""

    log_dir: str | None = None

    def _ignore(self, *args: Any, **kwargs: Any) -> None:
        pass

    log_metric = log_metrics = log_params = add_figure = flush = _ignore


class ActionRounds(ActiveInference):
    r"""Rows by round of the belief they were drawn from, and the trials in between.

    It is mixed in before a trainer of sbi's, whose private hooks it overrides
    (``tests/inference/trainers/test_active.py`` lists them). Without actions that
    trainer does what it always does. A round with them is that of Algorithm 1: this
    round's rows, a network built anew, plain maximum likelihood. This library's
    networks are trained by :func:`.train_network`: sbi's loop takes several times as
    long on networks this small.

    Args:
        args: Arguments of sbi's trainer. Rounds with actions need a prior with a
            support. What is trained is a name or a builder of sbi's, or this library's
            settings; None is sbi's default without actions and the default settings
            with them. Without a tracker nothing is tracked, so that no folder appears.
        kwargs: Arguments of sbi's trainer by name.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331.
    """

    #: This library's settings, the default where actions are given.
    _settings: ClassVar[type] = MixtureDensity
    #: sbi's name of the estimator.
    _sbi_name: ClassVar[str] = "density_estimator"
    #: Whether outcomes may be measured in part.
    _takes_partial: ClassVar[bool] = False

    # Attributes of sbi's trainers.
    _device: str
    _round: int
    _neural_net: Any
    _action_estimator: Any
    train_indices: Tensor
    val_indices: Tensor

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Give public methods the signatures of the trainer of sbi's beside this."""
        super().__init_subclass__(**kwargs)
        theirs: Any = cls.__bases__[-1]
        if not issubclass(theirs, ActiveInference):
            for name in ("__init__", "append_simulations", "train"):
                made = extended(getattr(cls, name), getattr(theirs, name))
                setattr(cls, name, made)

    _theta_roundwise: list[Tensor]
    _x_roundwise: list[Tensor]
    _prior_masks: list[Tensor]
    _data_round_index: list[int]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        given = given_arguments(self._sbi.__init__, args, kwargs)
        estimator = given.pop(self._sbi_name, None)
        ours = isinstance(estimator, self._settings)
        if estimator is not None and (callable(estimator) or not ours):
            given[self._sbi_name] = estimator
        self._sbi.__init__(**given)
        # A name stays one: the builder that sbi makes of it cannot be pickled.
        self._action_estimator = self._settings() if estimator is None else estimator
        self._trained_round: int | None = None
        self.trials = []

    def __getstate__(self) -> dict[str, Any]:
        # Builders of sbi's are local functions, which pickle refuses.
        estimator = cloudpickle.dumps(self._action_estimator)
        return {**self._sbi.__getstate__(), "_action_estimator": estimator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        estimator = cloudpickle.loads(state["_action_estimator"])
        self._sbi.__setstate__({**state, "_action_estimator": estimator})

    @property
    def _sbi(self) -> Any:
        """What sbi's trainer does, behind the methods that override it."""
        return super()

    @property
    def has_actions(self) -> bool:
        """Whether the rounds so far have actions."""
        return self._action_dim is not None

    @property
    def _has_settings(self) -> bool:
        """Whether rounds with actions train a network of this library."""
        return isinstance(self._action_estimator, self._settings)

    @abstractmethod
    def _network(self, theta: Tensor, x: Tensor) -> Any:
        """Return this library's network for rows as sbi's trainer sees them."""

    def _stored(self, rows: Simulations) -> tuple[Tensor, Tensor]:
        """Return the parameters and outcomes that sbi's trainer sees."""
        return rows.theta, pack(rows.x, rows.action)

    def train(self, *args: Any, **kwargs: Any) -> Any:
        """Train the estimator, with the arguments of sbi's own ``train``.

        Arguments that are not given are sbi's defaults, or with actions those of the
        settings. With actions the network is built anew at each call, unless
        ``resume_training``.

        Returns:
            The trained estimator; with actions its condition is packed.

        Raises:
            RuntimeError: If there are no simulations.
            ValueError: If training is to be resumed on other rows than it began with.
        """
        given = given_arguments(self._sbi.train, args, kwargs)
        if not self.has_actions:
            return self._sbi.train(**given)
        resume = given.get("resume_training", False)
        require(
            not resume or self._trained_round == max(self._data_round_index),
            "resume_training after train() on the same rows",
            "rows appended since",
            "train() without resume_training",
        )
        defaults = self._action_estimator.training if self._has_settings else {}
        arguments = {**defaults, **given, "retrain_from_scratch": not resume}
        with single_thread() if self._has_settings else nullcontext():
            network = self._train_round(**arguments)
        self._trained_round = self._round
        return network

    def _train_round(self, **arguments: Any) -> Any:
        """Train on a round with actions."""
        return self._sbi.train(**arguments)

    def _run_training_loop(
        self,
        train_loader: DataLoader,
        val_loader: DataLoader,
        train_config: TrainConfig,
        loss_args: LossArgs | None = None,
        summarization_kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Train; this library's networks with actions, by the lean loop."""
        trainer: Any = self
        config = train_config
        if not (self.has_actions and self._has_settings):
            return self._sbi._run_training_loop(
                train_loader, val_loader, config, loss_args, summarization_kwargs
            )
        settings, network = self._action_estimator, self._neural_net.to(self._device)
        if not config.resume_training:  # else the optimizer is the one so far
            self.optimizer = Adam(network.parameters(), rate=config.learning_rate)
        train_rows, held_out = self.train_indices, self.val_indices
        steps = max(len(train_rows) // config.training_batch_size, 1)
        row_loss, rows = self._prepared(network, loss_args)
        record = train_network(
            *(network, self.optimizer, row_loss, rows),
            train_rows=train_rows,
            held_out_rows=held_out,
            num_iterations=min(settings.num_iterations, steps * config.max_num_epochs),
            batch_size=config.training_batch_size,
            clip_max_norm=config.clip_max_norm,
            anneal=settings.anneal,
            patience=config.stop_after_epochs,
        )
        self._judge(network, *(part[held_out] for part in rows))
        # What sbi's own loop would write.
        trainer._best_val_loss = best = min(record.validation_loss)
        summary = trainer._summary
        summary["training_loss"] += record.training_loss
        summary["validation_loss"] += record.validation_loss
        summary["epoch_durations_sec"] += record.seconds
        summary["epochs_trained"].append(len(record.seconds))
        summary["best_validation_loss"].append(best)
        trainer._summarize(round_=self._round)
        if config.show_train_summary:
            print(trainer._describe_round(self._round, summary))
        return network

    def _prepared(
        self, network: Any, loss_args: LossArgs | None
    ) -> tuple[Callable[..., Tensor], tuple[Tensor, Tensor]]:
        """Return a loss, and this round's rows as it takes them, on the device."""
        theta, x, _ = self.get_simulations()
        rows = network.prepare(theta.to(self._device), x.to(self._device))
        return network.prepared_loss, rows

    def _judge(self, network: Any, *held_out: Tensor) -> None:
        """Settle what held-out rows decide of a trained network."""

    def _initialize_neural_network(
        self, retrain_from_scratch: bool, start_idx: int
    ) -> None:
        if self.has_actions:
            self._build_neural_net = self._build_action_network
        self._sbi._initialize_neural_network(retrain_from_scratch, start_idx)

    def _build_action_network(self, theta: Tensor, x: Tensor) -> Any:
        if self._has_settings:
            return self._network(theta, x)
        # sbi's constructor makes a builder of what it takes, which pickle loses.
        made = type(self).__new__(type(self))
        with warnings.catch_warnings():  # of names, said when this was made
            warnings.simplefilter("ignore", FutureWarning)
            made._sbi.__init__(**{self._sbi_name: self._action_estimator})
        return made._build_neural_net(theta, x)

    def _resolve_estimator(self, estimator: Any) -> Any:
        """Return the estimator of a posterior and its device, sbi's hook."""
        if estimator is None and self.has_actions:
            self._require_trained()
        return self._sbi._resolve_estimator(estimator)

    @abstractmethod
    def _model(self, estimator: Any, *arguments: Any) -> Any:
        """Return the learned model, from the arguments of ``_create_posterior``."""

    def _create_posterior(
        self,
        estimator: Any,
        prior: Any,
        sample_with: Any,
        device: Any,
        posterior_parameters: Any,
    ) -> Any:
        """Return sbi's posterior, with actions this library's model; sbi's hook."""
        arguments = (estimator, prior, sample_with, device, posterior_parameters)
        if self.has_actions:
            return self._model(*arguments)
        return self._sbi._create_posterior(*arguments)

    def _forget_round(self) -> None:
        self._trained_round = None

    def _is_round(self, action: Tensor | None, belief: Distribution | None) -> bool:
        """Return whether rows have actions, or raise where they must and do not."""
        if action is not None:
            require(
                self.has_actions or not self._data_round_index,
                "rounds without action, since earlier rounds of this trainer have none",
                "action=",
                f"start a new {type(self).__name__}(prior) for rounds with actions",
            )
            return True
        earlier = "earlier rounds of this trainer have actions"
        since = earlier if self.has_actions else "belief= was given"
        require(
            not self.has_actions and belief is None,
            f"action=, since {since}",
            "none",
            "pass the action of each row, or start a new trainer for rounds without "
            "actions",
        )
        return False

    def append_simulations(
        self,
        *args: Any,
        action: Tensor | None = None,
        belief: Distribution | None = None,
        **kwargs: Any,
    ) -> Self:
        r"""Store simulations for training, with the arguments of sbi's own method.

        Without ``action`` it is sbi's method. With it, the rows belong to the round of
        ``belief``; the same belief appended again continues that round.

        Args:
            args: Parameters theta, shape (n, theta_dim), drawn from the belief;
                outcomes x, shape (n, *x_shape), NaN where there was no measurement; and
                what else sbi's method takes. With actions, a ``proposal`` is the belief
                itself or sbi's ``RestrictedPrior`` of it. ``exclude_invalid_x`` says
                whether to drop rows with NaN: by default they are kept for this
                library's networks, as information, and dropped for sbi's, which cannot
                take them, with a warning. Information gain is biased towards actions
                that fail where they are dropped, since what failures tell about theta
                is lost and what is left is all success.
            action: Actions, shape (n, action_dim), or (action_dim,) for all rows.
            belief: The distribution of theta in this round; None is the current one.
            kwargs: Keyword arguments of that method.

        Returns:
            The trainer, so that calls chain.

        Raises:
            ValueError: If rounds with and without action mix, shapes do not fit, theta
                leaves the prior's support, or no row is valid; if a likelihood or ratio
                would be learned of outcomes that are observed in part.
        """
        given = given_arguments(self._sbi.append_simulations, args, kwargs)
        if not self._is_round(action, belief):
            return self._sbi.append_simulations(**given)
        assert action is not None
        check_proposal(given.get("proposal"), self.belief if belief is None else belief)
        exclude_invalid_x = given.get("exclude_invalid_x", not self._has_settings)
        theta, x = given["theta"], given["x"]
        if not (exclude_invalid_x or self._takes_partial):
            require_whole(x)
        device = given.get("data_device", self._device)
        own = theta, x, action, belief
        rows, is_new = self._new_rows(*own, exclude_invalid=exclude_invalid_x)
        current = max(self._data_round_index, default=-1)
        if is_new:
            current += 1
            # Nothing is trained on earlier rounds, which may be gigabytes.
            self._theta_roundwise, self._x_roundwise = [], []
        parameters, outcomes = (part.to(device) for part in self._stored(rows))
        if not is_new:
            earlier, seen, _ = self.get_simulations()
            parameters = torch.cat([earlier, parameters])
            outcomes = torch.cat([seen, outcomes])
        self._trained_round = None
        self._theta_roundwise, self._x_roundwise = [parameters], [outcomes]
        self._proposal_roundwise = [None]  # which sbi's posterior estimators have
        self._prior_masks = [mask_sims_from_prior(current, len(parameters))]
        self._data_round_index = [current]
        return self

    def get_simulations(self, starting_round: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        """Return parameters, outcomes and masks, with actions those of this round.

        Args:
            starting_round: Number of the first round; sbi's, of rounds without actions.
        """
        if not self.has_actions:
            return self._sbi.get_simulations(starting_round)
        # Of one tensor no copy is made.
        return self._theta_roundwise[0], self._x_roundwise[0], self._prior_masks[0]

    def _get_start_index(self, context: StartIndexContext) -> int:
        if not self.has_actions:
            return super()._get_start_index(context)  # pyright: ignore
        self._round = max(self._data_round_index)
        return self._round  # this round's rows only

    def _require_trained(self) -> None:
        if self._trained_round is None:
            raise RuntimeError(
                "expected a network trained under the current belief; got none since "
                "the last update() or append_simulations(); append simulations of "
                "the belief with action= and train() first"
            )

    def _default_tracker(self) -> Tracker:
        return SilentTracker()
