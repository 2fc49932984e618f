"""Action-extended NPE: sbi's NPE_C with an action in the condition."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any, Literal

import torch
from sbi.inference import NPE_C
from sbi.inference.trainers._contracts import (
    LossArgs,
    TrainConfig,
)
from sbi.inference.trainers.npe.npe_base import PosteriorEstimatorTrainer
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimatorBuilder,
)
from sbi.sbi_types import Tracker
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import DataLoader
from typing_extensions import Self

from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.mixture_network import MixtureDensityNetwork
from sbi_active.inference.networks.training import train_mixture_density
from sbi_active.inference.rounds.sbi_arguments import (
    NPE_DEFAULTS,
    action_arguments,
    given_arguments,
)
from sbi_active.inference.trainers.action_rounds import ActionRounds
from sbi_active.seeding import kept_generators
from sbi_active.threads import single_thread

__all__ = ["ActionNPE"]


class ActionNPE(ActionRounds, NPE_C):
    r"""Action-extended neural posterior estimation, section 4.2 of the paper.

    Without ``action=`` it is sbi's :class:`~sbi.inference.NPE_C`. With it, rows belong
    to the round of a belief, and the network is trained from scratch on this round's
    rows by plain maximum likelihood,

    .. math::
        \min_\phi - \sum_n \log q_\phi(\theta_n | x_n, \xi_n) \qquad \text{(Eq. 9)}.

    Args:
        prior: The prior over parameters.
        density_estimator: An sbi string or builder, or :class:`MixtureDensity`. None is
            sbi's default ("maf") without actions and ``MixtureDensity()`` with them.
        device: As in sbi.
        logging_level: As in sbi.
        summary_writer: As in sbi (deprecated there).
        tracker: As in sbi; None tracks nothing.
        show_progress_bars: As in sbi.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331.
    """

    def __init__(
        self,
        prior: Distribution | None = None,
        density_estimator: Literal["nsf", "maf", "mdn", "made"]
        | ConditionalEstimatorBuilder[ConditionalDensityEstimator]
        | None = None,
        device: str = "cpu",
        logging_level: int | str = "WARNING",
        summary_writer: Any = None,
        tracker: Tracker | None = None,
        show_progress_bars: bool = True,
    ) -> None:
        super().__init__(
            prior=prior,
            density_estimator="maf" if density_estimator is None else density_estimator,
            device=device,
            logging_level=logging_level,
            summary_writer=summary_writer,
            tracker=tracker,
            show_progress_bars=show_progress_bars,
        )
        self._action_estimator = (
            MixtureDensity() if density_estimator is None else self._build_neural_net
        )

    @property
    def _keeps_invalid(self) -> bool:
        return isinstance(self._action_estimator, MixtureDensity)

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        proposal: Any = None,
        exclude_invalid_x: bool | None = None,
        data_device: str | None = None,
        *,
        action: Tensor | None = None,
        belief: Distribution | None = None,
    ) -> Self:
        r"""Store simulations for training.

        Without ``action`` this is sbi's method. With it, the rows belong to the round
        of ``belief``; the same belief appended again continues that round.

        Args:
            theta: Parameters, shape (n, theta_dim), drawn from the belief.
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            proposal: Without actions as in sbi. With them, None, the belief itself or
                sbi's ``RestrictedPrior`` of it.
            exclude_invalid_x: With actions, None keeps rows with NaN as information
                for :class:`MixtureDensity`, and drops them for sbi's networks, which
                cannot take them, with a warning. True drops them: information gain is
                then biased towards actions that fail, since what failures tell about
                theta is lost and what is left is all success.
            data_device: Where to keep the rows.
            action: Shape (n, action_dim), or (action_dim,) for all rows.
            belief: The distribution of theta in this round; None is the current one.

        Returns:
            The trainer, so that calls chain.

        Raises:
            ValueError: If rounds with and without action mix, shapes do not fit, theta
                leaves the prior's support, or no row is valid.
        """
        if not self._is_round(action, belief):
            return super().append_simulations(
                theta, x, proposal, exclude_invalid_x, data_device
            )
        assert action is not None
        self._append_round(
            theta, x, action, belief, exclude_invalid_x, data_device, proposal
        )
        self._proposal_roundwise.append(None)
        return self

    def train(
        self,
        num_atoms: int | None = None,
        training_batch_size: int | None = None,
        learning_rate: float | None = None,
        validation_fraction: float | None = None,
        stop_after_epochs: int | None = None,
        max_num_epochs: int | None = None,
        clip_max_norm: float | None = NPE_DEFAULTS["clip_max_norm"],
        calibration_kernel: Callable | None = None,
        resume_training: bool = False,
        force_first_round_loss: bool = False,
        discard_prior_samples: bool = False,
        use_combined_loss: bool = False,
        retrain_from_scratch: bool = False,
        show_train_summary: bool = False,
        dataloader_kwargs: dict | None = None,
    ) -> ConditionalDensityEstimator:
        """Train the density estimator.

        Without actions, and for a network of sbi's with actions, the arguments are
        those of sbi's ``NPE_C.train`` and None is its default. For
        :class:`MixtureDensity`, None is what its settings say: ``training_batch_size``
        and ``learning_rate`` override them, ``max_num_epochs`` caps the number of
        iterations, and ``stop_after_epochs`` adds a patience on held-out rows. With
        actions the network is rebuilt at each call, unless ``resume_training``.

        Returns:
            The trained estimator; with actions its condition is packed (x, action).

        Raises:
            RuntimeError: If there are no simulations.
            ValueError: If an argument has no meaning in a round with actions.
        """
        given = given_arguments(locals())
        if not self.has_actions:
            return super().train(**{**NPE_DEFAULTS, **given})
        self._require_same_rows(resume_training)
        settings = self._action_estimator
        lean = isinstance(settings, MixtureDensity)
        arguments = action_arguments(given, settings if lean else None)
        self._epoch_limit = given.get("max_num_epochs")
        self._patience = given.get("stop_after_epochs")
        self._kernel = calibration_kernel
        # NPE_C.train would choose a multi-round loss here; its parent's train is plain
        # maximum likelihood on the rows that _get_start_index names.
        with single_thread() if lean else nullcontext():
            network = PosteriorEstimatorTrainer.train(self, **arguments)
        self._trained_round = self._round
        return network

    def _initialize_neural_network(
        self, retrain_from_scratch: bool, start_idx: int
    ) -> None:
        if self.has_actions:
            settings = self._action_estimator
            if isinstance(settings, MixtureDensity):
                assert self._action_dim is not None
                # It does better where it knows which numbers are the action.
                settings = partial(settings.build, action_dim=self._action_dim)
            self._build_neural_net = settings
        super()._initialize_neural_network(retrain_from_scratch, start_idx)

    def _run_training_loop(
        self,
        train_loader: DataLoader,
        val_loader: DataLoader,
        train_config: TrainConfig,
        loss_args: LossArgs | None = None,
        summarization_kwargs: dict[str, Any] | None = None,
    ) -> ConditionalDensityEstimator:
        """Train; for :class:`MixtureDensity` with actions, by the lean loop."""
        network, settings = self._neural_net, self._action_estimator
        if not (
            self.has_actions
            and isinstance(network, MixtureDensityNetwork)
            and isinstance(settings, MixtureDensity)
        ):
            return super()._run_training_loop(
                train_loader, val_loader, train_config, loss_args, summarization_kwargs
            )
        network.to(self._device)
        if not train_config.resume_training:
            self.optimizer = torch.optim.Adam(
                network.parameters(), lr=train_config.learning_rate, fused=True
            )
        theta, condition, _ = self.get_simulations(self._round)
        record = train_mixture_density(
            network,
            self.optimizer,
            theta.to(self._device),
            condition.to(self._device),
            train_rows=self.train_indices,
            held_out_rows=self.val_indices,
            budget=self._training_budget(
                settings, train_config, len(self.train_indices)
            ),
            calibration_kernel=self._kernel,
        )
        self._summarize_training(record, train_config)
        return network

    def build_posterior(
        self,
        density_estimator: ConditionalDensityEstimator | None = None,
        prior: Distribution | None = None,
        sample_with: Literal[
            "mcmc", "rejection", "vi", "importance", "direct"
        ] = "direct",
        mcmc_method: Literal[
            "slice_np",
            "slice_np_vectorized",
            "hmc_pyro",
            "nuts_pyro",
            "slice_pymc",
            "hmc_pymc",
            "nuts_pymc",
        ] = "slice_np_vectorized",
        vi_method: Literal["rKL", "fKL", "IW", "alpha"] = "rKL",
        direct_sampling_parameters: dict[str, Any] | None = None,
        mcmc_parameters: dict[str, Any] | None = None,
        vi_parameters: dict[str, Any] | None = None,
        rejection_sampling_parameters: dict[str, Any] | None = None,
        importance_sampling_parameters: dict[str, Any] | None = None,
        posterior_parameters: Any = None,
    ) -> Any:
        """Return the posterior: sbi's own without actions, else an ActionPosterior.

        The arguments are those of sbi's ``NPE_C.build_posterior``; with actions,
        ``prior=None`` is the belief of this round.

        Returns:
            sbi's ``NeuralPosterior``, or an :class:`.ActionPosterior`.

        Raises:
            RuntimeError: If rows of an action round came in after the last ``train``.
        """
        arguments = {
            name: value
            for name, value in locals().items()
            if name not in ("self", "__class__")
        }
        if not self.has_actions:
            return super().build_posterior(**arguments)
        if density_estimator is None:
            self._require_trained()
        if prior is None:
            arguments["prior"] = self._round_belief
        with kept_generators():  # sbi draws from the prior to look at it
            packed = super().build_posterior(**arguments)
        assert self._action_dim is not None
        assert self._outcome_shape is not None
        return ActionPosterior(packed, self._outcome_shape, self._action_dim)
