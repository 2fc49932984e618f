"""Sequential Bayesian experimental design with ratios that all parameters share."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from typing import Any, Literal

from sbi.inference import NRE_B, NRE_C
from sbi.inference.trainers.nre.nre_base import RatioEstimatorTrainer
from sbi.neural_nets.estimators.base import ConditionalEstimatorBuilder
from sbi.neural_nets.ratio_estimators import RatioEstimator
from sbi.sbi_types import Tracker
from sbi.utils.sbiutils import del_entries
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.inference.beliefs.kernel_belief import Bandwidth
from sbi_active.inference.models.action_ratio import ActionRatio
from sbi_active.inference.networks.ratio_network import RatioClassifier, RatioNetwork
from sbi_active.inference.trainers.product_rounds import ProductRounds
from sbi_active.threads import single_thread

__all__ = ["SeqBED_B", "SeqBED_C"]

Classifier = str | ConditionalEstimatorBuilder[RatioEstimator] | RatioClassifier


class AmortizedRounds(ProductRounds, RatioEstimatorTrainer):
    r"""What the two losses share.

    Without ``action=`` these are sbi's trainers, to the last bit at the same torch seed
    (but for a silent tracker). With it a round trains a classifier of (theta, x,
    action) on this round's rows. Parameters and actions being independent in a round,
    its log odds are

    .. math::
        \log r(\theta; x, \xi) = \log \frac{p(x | \theta, \xi)}{p(x | \xi)},

    the utility of an action is their mean, and the belief is the original prior times
    the product of ratios over the history.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        classifier: An sbi string or builder, or :class:`RatioClassifier`. None is sbi's
            default ("resnet") without actions and ``RatioClassifier()`` with them.
        device: As in sbi.
        logging_level: As in sbi.
        summary_writer: As in sbi (deprecated there).
        tracker: As in sbi; None tracks nothing.
        show_progress_bars: As in sbi.
        posterior: How beliefs are sampled, see
            :class:`.ProductRounds`.
        bandwidth: Of "kde".
    """

    _factor = ActionRatio

    def __init__(
        self,
        prior: Distribution | None = None,
        classifier: Classifier | None = None,
        device: str = "cpu",
        logging_level: int | str = "warning",
        summary_writer: Any = None,
        tracker: Tracker | None = None,
        show_progress_bars: bool = True,
        *,
        posterior: str = "importance",
        bandwidth: Bandwidth = "scott",
    ) -> None:
        own = isinstance(classifier, RatioClassifier)
        super().__init__(
            prior=prior,
            classifier="resnet" if classifier is None or own else classifier,
            device=device,
            logging_level=logging_level,
            summary_writer=summary_writer,
            tracker=tracker,
            show_progress_bars=show_progress_bars,
            posterior=posterior,
            bandwidth=bandwidth,
        )
        default = RatioClassifier() if classifier is None else self._build_neural_net
        self._action_classifier = classifier if own else default

    @property
    def _keeps_invalid(self) -> bool:
        return isinstance(self._action_classifier, RatioClassifier)

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        exclude_invalid_x: bool | None = None,
        from_round: int = 0,
        algorithm: str = "NRE",
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
            exclude_invalid_x: With actions, None keeps rows without a measurement for
                :class:`RatioClassifier`, and drops them for sbi's networks, with a
                warning.
            from_round: As in sbi; without meaning where there are actions.
            algorithm: As in sbi.
            data_device: Where to keep the rows.
            action: Shape (n, action_dim), or (action_dim,) for all rows.
            belief: The distribution of theta in this round; None is the current one.

        Raises:
            ValueError: If rounds with and without action mix, shapes do not fit, or
                theta leaves the prior's support.
        """
        if not self._is_round(action, belief):
            return super().append_simulations(  # pyright: ignore
                theta, x, bool(exclude_invalid_x), from_round, algorithm, data_device
            )
        assert action is not None
        return self._append_round(
            theta, x, action, belief, exclude_invalid_x, data_device
        )

    def _train(
        self, given: dict[str, Any], loss: dict[str, Any], *, resume: bool
    ) -> RatioEstimator:
        """Train with the arguments that were given, by the loss of the subclass."""
        arguments = {name: value for name, value in given.items() if value is not None}
        arguments["clip_max_norm"] = given["clip_max_norm"]  # None does not clip
        settings = self._action_classifier
        own = self.has_actions and isinstance(settings, RatioClassifier)
        if isinstance(settings, RatioClassifier) and own:
            num_rows = len(self._round_parameters())
            num_rows -= int(num_rows * given["validation_fraction"])
            steps = max(num_rows // settings.batch_size, 1)
            defaults = {
                "training_batch_size": settings.batch_size,
                "learning_rate": settings.learning_rate,
                "max_num_epochs": max(settings.num_iterations // steps, 1),
                "stop_after_epochs": settings.stop_after_epochs,
            }
            arguments = {**defaults, **arguments}
        if self.has_actions:
            self._require_same_rows(resume)
            arguments["retrain_from_scratch"] = not resume
        with single_thread() if own else nullcontext(), warnings.catch_warnings():
            if own:  # the number of epochs is a setting
                warnings.filterwarnings("ignore", message="Maximum number of epochs")
            network = super().train(**arguments, **loss)  # pyright: ignore
        self._trained_round = self._round
        return network

    def _report_convergence_at_end(self, epoch: int, max_num_epochs: int) -> None:
        if self.has_actions and not self._show_progress_bars:
            return  # sbi prints a line
        super()._report_convergence_at_end(epoch, max_num_epochs)  # pyright: ignore

    def _initialize_neural_network(
        self, retrain_from_scratch: bool, start_idx: int
    ) -> None:
        if self.has_actions:
            self._build_neural_net = self._build_action_network
        super()._initialize_neural_network(  # pyright: ignore
            retrain_from_scratch, start_idx
        )

    def _build_action_network(self, theta: Tensor, condition: Tensor) -> RatioEstimator:
        settings = self._action_classifier
        assert self._action_dim is not None
        if isinstance(settings, RatioClassifier):
            return RatioNetwork(settings, theta, condition, self._action_dim)
        return settings(theta, condition)  # pyright: ignore

    def build_posterior(
        self,
        density_estimator: RatioEstimator | None = None,
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

        The arguments are those of sbi's ``NRE`` trainers; with actions only the first
        has a meaning, and :meth:`update` samples.

        Returns:
            sbi's ``NeuralPosterior``, or an :class:`.ActionRatio`.

        Raises:
            RuntimeError: If rows of an action round came in after the last ``train``.
        """
        arguments = {
            name: value
            for name, value in locals().items()
            if name not in ("self", "__class__")
        }
        if not self.has_actions:
            return super().build_posterior(**arguments)  # pyright: ignore
        return self._learned(density_estimator)


class SeqBED_B(AmortizedRounds, NRE_B):  # noqa: N801 - as NRE_B
    r"""Amortized SeqBED by multi-class classification, on sbi's NRE_B.

    The classifier's ratio is right but for a function of (x, action), which no belief
    depends on; the mean log ratio does. Design with
    :class:`.InfoNCEGain`, or take :class:`SeqBED_C`.

    References:
        Durkan, Murray & Papamakarios, ICML 2020; Kleinegesse, Drovandi & Gutmann,
        Bayesian Analysis 2021.
    """

    def train(
        self,
        num_atoms: int = 10,
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
    ) -> RatioEstimator:
        """Train the classifier.

        The arguments are those of sbi's ``NRE_B.train``. None is its default, and for
        :class:`RatioClassifier` what its settings say. With actions the network is
        rebuilt at each call, unless ``resume_training``.
        """
        given = del_entries(locals(), entries=("self", "num_atoms", "__class__"))
        return self._train(given, {"num_atoms": num_atoms}, resume=resume_training)


class SeqBED_C(AmortizedRounds, NRE_C):  # noqa: N801 - as NRE_C
    r"""Amortized SeqBED by contrastive ratio estimation, on sbi's NRE_C.

    Its log odds are the log ratio itself, so that their mean is the utility of SeqBED.

    References:
        Miller, Weniger & Forre, NeurIPS 2022; Kleinegesse, Drovandi & Gutmann, Bayesian
        Analysis 2021.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(-torch.ones(1), torch.ones(1))
        >>> theta, action = prior.sample((1_000,)), torch.rand(1_000, 1)
        >>> x = theta * action + 0.1 * torch.randn(1_000, 1)
        >>> inference = SeqBED_C(prior, show_progress_bars=False)
        >>> _ = inference.append_simulations(theta, x, action=action).train()
        >>> belief = inference.update(
        ...     torch.tensor([0.3]), action=torch.tensor([0.6]), seed=0)
        >>> bool((belief.mean - 0.5).abs() < 0.1)
        True
    """

    def train(
        self,
        num_classes: int = 5,
        gamma: float = 1.0,
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
    ) -> RatioEstimator:
        """Train the classifier.

        The arguments are those of sbi's ``NRE_C.train``. None is its default, and for
        :class:`RatioClassifier` what its settings say. With actions the network is
        rebuilt at each call, unless ``resume_training``.
        """
        loss = {"num_classes": num_classes, "gamma": gamma}
        given = del_entries(locals(), entries=("self", "loss", *loss, "__class__"))
        return self._train(given, loss, resume=resume_training)
