"""Rounds that learn a factor of the likelihood: a surrogate of it, or a ratio."""

from __future__ import annotations

import warnings
from inspect import signature
from typing import Any

import torch
from sbi.inference import NLE_A, NRE_C
from sbi.inference.trainers._contracts import TrainConfig
from sbi.neural_nets.ratio_estimators import RatioEstimator
from torch import Tensor
from typing_extensions import Self

from sbi_active.inference.models.factors import ActionLikelihood, ActionRatio
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.networks.likelihood_network import LikelihoodNetwork
from sbi_active.inference.networks.mixture_density import TrainingRecord
from sbi_active.inference.networks.ratio_network import RatioClassifier, RatioNetwork
from sbi_active.inference.trainers.action_rounds import extends
from sbi_active.inference.trainers.mixture_rounds import MixtureRounds
from sbi_active.inference.trainers.product_rounds import ProductRounds
from sbi_active.inference.trainers.seqbed import SeqBED_LFIRE
from sbi_active.messages import ChangedWarning, warn
from sbi_active.simulation.outcomes import Simulations

#: Keywords of SeqBED in the last version alone.
LFIRE_KEYWORDS = {"settings", "num_particles"}


class ALHI(ProductRounds, MixtureRounds, NLE_A):
    r"""Active likelihood-based inference, the paper's ALHI; at random actions NLHI.

    Without ``action=`` it is sbi's :class:`~sbi.inference.NLE_A`, to the last bit at
    the same torch seed (but for a silent tracker). With it, a round trains a surrogate
    likelihood from scratch on this round's rows,

    .. math::
        \min_\phi - \sum_n \log q_\phi(x_n | \theta_n, \xi_n),

    actions are designed by :math:`\log q(x | \theta, \xi) - \log \int q(x | \theta',
    \xi)\, p(\theta')\, \mathrm d\theta'`, and the belief is the original prior times
    the product over the history. ``build_posterior`` then gives an
    :class:`.ActionLikelihood`, and ``update`` samples: what else sbi's
    ``build_posterior`` takes has no meaning.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        density_estimator: An sbi string or builder, or :class:`MixtureDensity`. None is
            sbi's default ("maf") without actions and ``MixtureDensity()`` with them: a
            regression of x on (theta, action), and a mixture density network on what
            it leaves.
            ``MixtureDensity.faithful()`` is the paper's.
        args: Further arguments of sbi's; without a tracker nothing is tracked.
        kwargs: Further arguments of sbi's by name.
        posterior: Sampling method for beliefs, see :class:`.ProductRounds`; "kde" is
            the paper's.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331; Papamakarios,
        Sterratt & Murray, AISTATS 2019.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import MixtureDensity
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

    @extends(NLE_A.__init__)
    def __init__(
        self, *args: Any, posterior: str = "importance", **kwargs: Any
    ) -> None:
        super().__init__(*args, posterior=posterior, **kwargs)

    def _stored(self, rows: Simulations) -> tuple[Tensor, Tensor]:
        return torch.cat([rows.theta, rows.action], 1), rows.x.flatten(1).clone()

    @extends(NLE_A.train)
    def train(self, *args: Any, **kwargs: Any) -> Any:
        """Train the density estimator, see :meth:`.ActionRounds.train`."""
        return super().train(*args, **kwargs)

    def _network(self, theta: Tensor, x: Tensor) -> LikelihoodNetwork:
        assert self._action_dim is not None
        return LikelihoodNetwork(self._action_estimator, x, theta, self._action_dim)

    def _train_mixture(self, config: TrainConfig) -> TrainingRecord:
        network = self._neural_net
        condition, x = self._round_rows()
        rows = [
            network.residual_rows(x[index], condition[index])
            for index in (self.train_indices, self.val_indices)
        ]
        residual, seen = (torch.cat(parts) for parts in zip(*rows, strict=True))
        order, num_train = torch.arange(len(residual)), len(rows[0][0])
        record = self._trained(
            *(network.mixture, config, residual, seen),
            train_rows=order[:num_train],
            held_out_rows=order[num_train:],
        )
        network.choose(*rows[1])
        network.eval()
        return record


class SeqBED(ProductRounds, NRE_C):
    r"""Amortized SeqBED by contrastive ratio estimation, on sbi's NRE_C.

    Without ``action=`` it is sbi's :class:`~sbi.inference.NRE_C`, to the last bit at
    the same torch seed (but for a silent tracker). With it a round trains a classifier
    of (theta, x, action) on this round's rows. Parameters and actions being independent
    in a round, its log odds are

    .. math::
        \log r(\theta; x, \xi) = \log \frac{p(x | \theta, \xi)}{p(x | \xi)},

    the utility of an action is their mean, and the belief is the original prior times
    the product of ratios over the history. ``build_posterior`` then gives an
    :class:`.ActionRatio`, and ``update`` samples: what else sbi's ``build_posterior``
    takes has no meaning.

    As published, with a logistic regression for each parameter set and action, it is
    :class:`.SeqBED_LFIRE`, which had this name in the last version: until the next one,
    ``SeqBED(prior, LFIRE())`` and its keywords still give that, with a warning.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        classifier: An sbi string or builder, or :class:`RatioClassifier`. None is sbi's
            default ("resnet") without actions and ``RatioClassifier()`` with them.
        args: Further arguments of sbi's; without a tracker nothing is tracked.
        kwargs: Further arguments of sbi's by name.
        posterior: Sampling method for beliefs, see :class:`.ProductRounds`.

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
        >>> inference = SeqBED(prior, show_progress_bars=False)
        >>> _ = inference.append_simulations(theta, x, action=action).train()
        >>> belief = inference.update(
        ...     torch.tensor([0.3]), action=torch.tensor([0.6]), seed=0)
        >>> bool((belief.mean - 0.5).abs() < 0.1)
        True
    """

    _factor = ActionRatio
    _settings = RatioClassifier
    _sbi_name = "classifier"
    _action_estimator: Any
    _is_default: bool

    @extends(NRE_C.__init__)
    def __init__(
        self, *args: Any, posterior: str = "importance", **kwargs: Any
    ) -> None:
        super().__init__(*args, posterior=posterior, **kwargs)

    def _network(self, theta: Tensor, x: Tensor) -> RatioNetwork:
        assert self._action_dim is not None
        return RatioNetwork(self._action_estimator, theta, x, self._action_dim)

    def _training_defaults(self, given: dict[str, Any]) -> dict[str, Any]:
        settings: RatioClassifier = self._action_estimator
        num_rows = len(self._round_parameters())
        fraction = signature(NRE_C.train).parameters["validation_fraction"]
        num_rows -= int(num_rows * given.get(fraction.name, fraction.default))
        steps = max(num_rows // settings.batch_size, 1)
        return {
            "training_batch_size": settings.batch_size,
            "learning_rate": settings.learning_rate,
            "max_num_epochs": max(settings.num_iterations // steps, 1),
            "stop_after_epochs": settings.stop_after_epochs,
        }

    def _train_round(self, **arguments: Any) -> RatioEstimator:
        with warnings.catch_warnings():
            if self._has_settings:  # the number of epochs is one of them
                warnings.filterwarnings("ignore", message="Maximum number of epochs")
            return super()._train_round(**arguments)

    def _report_convergence_at_end(self, epoch: int, max_num_epochs: int) -> None:
        if self.has_actions and not self._show_progress_bars:
            return  # sbi prints a line
        super()._report_convergence_at_end(epoch, max_num_epochs)  # pyright: ignore

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make it, or what the arguments meant in the last version."""
        classifier = args[1] if len(args) > 1 else kwargs.get("classifier")
        if isinstance(classifier, LFIRE) or LFIRE_KEYWORDS & {*kwargs}:
            warn(
                "SA701 sbi_active.SeqBED of logistic regressions goes in the next "
                "version: use sbi_active.inference.SeqBED_LFIRE",
                stacklevel=2,
            )
            return SeqBED_LFIRE(*args, **kwargs)  # pyright: ignore[reportReturnType]
        made = super().__new__(cls)
        made._is_default = len(args) < 2 and classifier is None
        return made

    def arrange(self, theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the draws as they are, see :meth:`.ActiveInference.arrange`."""
        if self._is_default:  # this method is what the class of that name asked for
            warn(
                "SA702 SeqBED(prior) learns one ratio for all parameters, as SeqBED_C "
                "did in the last version; for a logistic regression at each particle "
                "use sbi_active.inference.SeqBED_LFIRE(prior), and for this one pass "
                "SeqBED(prior, RatioClassifier())",
                ChangedWarning,
                stacklevel=2,
            )
        return super().arrange(theta, action)

    @extends(NRE_C.train)
    def train(self, *args: Any, **kwargs: Any) -> Any:
        """Train the classifier, see :meth:`.ActionRounds.train`."""
        return super().train(*args, **kwargs)
