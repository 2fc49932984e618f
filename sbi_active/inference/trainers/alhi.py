"""Active likelihood-based inference: the surrogate likelihood of outcome and action."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, Literal

import torch
from sbi.inference import NLE_A
from sbi.inference.trainers._contracts import LossArgs, TrainConfig
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimatorBuilder,
)
from sbi.sbi_types import Tracker
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import DataLoader
from typing_extensions import Self

from sbi_active.inference.beliefs.kernel_belief import Bandwidth
from sbi_active.inference.models.action_likelihood import ActionLikelihood
from sbi_active.inference.networks.likelihood_network import LikelihoodNetwork
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.training import train_mixture_density
from sbi_active.inference.rounds.rows import RoundRows
from sbi_active.inference.trainers.product_rounds import ProductRounds
from sbi_active.threads import single_thread

__all__ = ["ALHI"]


class ALHI(ProductRounds, NLE_A):
    r"""Active likelihood-based inference, the paper's ALHI; at random actions NLHI.

    Without ``action=`` it is sbi's :class:`~sbi.inference.NLE_A`, to the last bit at
    the same torch seed (but for a silent tracker). With it, a round trains a surrogate
    likelihood from scratch on this round's rows,

    .. math::
        \min_\phi - \sum_n \log q_\phi(x_n | \theta_n, \xi_n),

    actions are designed by :math:`\log q(x | \theta, \xi) - \log \int q(x | \theta',
    \xi)\, p(\theta')\, \mathrm d\theta'`, and the belief is the original prior times
    the product over the history.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        density_estimator: An sbi string or builder, or :class:`MixtureDensity`. None is
            sbi's default ("maf") without actions and ``MixtureDensity()`` with them: a
            regression of x on (theta, action), and a mixture density network on what
            it leaves.
            ``MixtureDensity.faithful()`` is the paper's.
        device: As in sbi.
        logging_level: As in sbi.
        summary_writer: As in sbi (deprecated there).
        tracker: As in sbi; None tracks nothing.
        show_progress_bars: As in sbi.
        posterior: How beliefs are sampled, see
            :class:`.ProductRounds`; "kde" is the
            paper's.
        bandwidth: Of "kde".

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331; Papamakarios,
        Sterratt & Murray, AISTATS 2019.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(-torch.ones(1), torch.ones(1))
        >>> theta, action = prior.sample((500,)), torch.rand(500, 1)
        >>> x = theta * action + 0.1 * torch.randn(500, 1)
        >>> settings = MixtureDensity(num_iterations=50)
        >>> inference = ALHI(prior, settings, show_progress_bars=False)
        >>> _ = inference.append_simulations(theta, x, action=action).train()
        >>> belief = inference.update(
        ...     torch.tensor([0.3]), action=torch.tensor([0.6]), seed=0)
        >>> bool((belief.mean - 0.5).abs() < 0.1)
        True
    """

    _factor = ActionLikelihood

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
        *,
        posterior: str = "importance",
        bandwidth: Bandwidth = "scott",
    ) -> None:
        super().__init__(
            prior=prior,
            density_estimator="maf" if density_estimator is None else density_estimator,
            device=device,
            logging_level=logging_level,
            summary_writer=summary_writer,
            tracker=tracker,
            show_progress_bars=show_progress_bars,
            posterior=posterior,
            bandwidth=bandwidth,
        )
        self._action_estimator = (
            MixtureDensity() if density_estimator is None else self._build_neural_net
        )

    @property
    def _keeps_invalid(self) -> bool:
        return isinstance(self._action_estimator, MixtureDensity)

    def _stored(self, rows: RoundRows) -> tuple[Tensor, Tensor]:
        return torch.cat([rows.theta, rows.action], 1), rows.x.flatten(1)

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        exclude_invalid_x: bool | None = None,
        from_round: int = 0,
        algorithm: str = "NLE",
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
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            exclude_invalid_x: With actions, None keeps rows without a measurement for
                :class:`MixtureDensity`, which learns their probability, and drops them
                for sbi's networks, with a warning.
            from_round: As in sbi; without meaning where there are actions.
            algorithm: As in sbi.
            data_device: Where to keep the rows.
            action: Shape (n, action_dim), or (action_dim,) for all rows.
            belief: The distribution of theta in this round; None is the current one.

        Raises:
            ValueError: If rounds with and without action mix, shapes do not fit, theta
                leaves the prior's support, or an outcome is observed in part.
        """
        if not self._is_round(action, belief):
            return super().append_simulations(
                theta, x, bool(exclude_invalid_x), from_round, algorithm, data_device
            )
        assert action is not None
        return self._append_round(
            theta, x, action, belief, exclude_invalid_x, data_device
        )

    def train(
        self,
        training_batch_size: int | None = None,
        learning_rate: float | None = None,
        validation_fraction: float = 0.1,
        stop_after_epochs: int | None = None,
        max_num_epochs: int | None = None,
        clip_max_norm: float | None = 5.0,
        resume_training: bool = False,
        discard_prior_samples: bool = False,
        retrain_from_scratch: bool = False,
        show_train_summary: bool = False,
        dataloader_kwargs: dict | None = None,
    ) -> ConditionalDensityEstimator:
        """Train the density estimator.

        The arguments are those of sbi's ``NLE_A.train``. None is its default, and for
        :class:`MixtureDensity` what its settings say. With actions the network is
        rebuilt at each call, unless ``resume_training``.

        Returns:
            The trained estimator; with actions its condition is packed (theta, action).

        Raises:
            RuntimeError: If there are no simulations.
        """
        settings = self._action_estimator
        lean = self.has_actions and isinstance(settings, MixtureDensity)
        if isinstance(settings, MixtureDensity) and lean:
            training_batch_size = training_batch_size or settings.batch_size
            learning_rate = learning_rate or settings.learning_rate
        given = {
            "training_batch_size": training_batch_size,
            "learning_rate": learning_rate,
            "stop_after_epochs": stop_after_epochs,
            "max_num_epochs": max_num_epochs,
        }
        self._epoch_limit, self._patience = max_num_epochs, stop_after_epochs
        if self.has_actions:
            self._require_same_rows(resume_training)
            retrain_from_scratch = not resume_training
        with single_thread() if lean else nullcontext():
            network = super().train(
                **{name: value for name, value in given.items() if value is not None},
                validation_fraction=validation_fraction,
                clip_max_norm=clip_max_norm,
                resume_training=resume_training,
                discard_prior_samples=discard_prior_samples,
                retrain_from_scratch=retrain_from_scratch,
                show_train_summary=show_train_summary,
                dataloader_kwargs=dataloader_kwargs,
            )
        self._trained_round = self._round
        return network

    def _initialize_neural_network(
        self, retrain_from_scratch: bool, start_idx: int
    ) -> None:
        if self.has_actions:
            self._build_neural_net = self._build_action_network
        super()._initialize_neural_network(retrain_from_scratch, start_idx)

    def _build_action_network(
        self, condition: Tensor, x: Tensor
    ) -> ConditionalDensityEstimator:
        settings = self._action_estimator
        assert self._action_dim is not None
        if isinstance(settings, MixtureDensity):
            return LikelihoodNetwork(settings, x, condition, self._action_dim)
        return settings(condition, x)

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
            isinstance(network, LikelihoodNetwork)
            and isinstance(settings, MixtureDensity)
        ):
            return super()._run_training_loop(
                train_loader, val_loader, train_config, loss_args, summarization_kwargs
            )
        network.to(self._device)
        if not train_config.resume_training:
            self.optimizer = torch.optim.Adam(
                network.mixture.parameters(), lr=train_config.learning_rate
            )
        condition, x, _ = self.get_simulations(self._round)
        rows = [
            network.residual_rows(x[index], condition[index])
            for index in (self.train_indices, self.val_indices)
        ]
        residual, seen = (torch.cat(parts) for parts in zip(*rows, strict=True))
        order, num_train = torch.arange(len(residual)), len(rows[0][0])
        record = train_mixture_density(
            network.mixture,
            self.optimizer,
            residual,
            seen,
            train_rows=order[:num_train],
            held_out_rows=order[num_train:],
            budget=self._training_budget(settings, train_config, num_train),
        )
        network.choose(*rows[1])
        network.eval()
        self._summarize_training(record, train_config)
        return network

    def build_posterior(
        self,
        density_estimator: ConditionalDensityEstimator | None = None,
        prior: Distribution | None = None,
        sample_with: Literal["mcmc", "rejection", "vi", "importance"] = "mcmc",
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
        mcmc_parameters: dict[str, Any] | None = None,
        vi_parameters: dict[str, Any] | None = None,
        rejection_sampling_parameters: dict[str, Any] | None = None,
        importance_sampling_parameters: dict[str, Any] | None = None,
        posterior_parameters: Any = None,
    ) -> Any:
        """Return sbi's posterior without actions, else what was learned.

        The arguments are those of sbi's ``NLE_A.build_posterior``; with actions only
        the first has a meaning, and :meth:`update` samples.

        Returns:
            sbi's ``NeuralPosterior``, or an :class:`.ActionLikelihood`.

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
        return self._learned(density_estimator)
