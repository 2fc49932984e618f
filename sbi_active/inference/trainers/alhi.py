"""Active likelihood-based inference: the surrogate likelihood of outcome and action."""

from __future__ import annotations

from typing import Any

import torch
from sbi.inference import NLE_A
from sbi.inference.trainers._contracts import TrainConfig
from torch import Tensor

from sbi_active.inference.models.factors import ActionLikelihood
from sbi_active.inference.networks.likelihood_network import LikelihoodNetwork
from sbi_active.inference.networks.mixture_density import TrainingRecord
from sbi_active.inference.trainers.action_rounds import extends, takes
from sbi_active.inference.trainers.mixture_rounds import MixtureRounds
from sbi_active.inference.trainers.product_rounds import ProductRounds
from sbi_active.simulation.outcomes import Simulations


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
        self,
        *args: Any,
        posterior: str = "importance",
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, posterior=posterior, **kwargs)

    def _stored(self, rows: Simulations) -> tuple[Tensor, Tensor]:
        return torch.cat([rows.theta, rows.action], 1), rows.x.flatten(1).clone()

    @takes(NLE_A.train)
    def train(self, *args: Any, **kwargs: Any) -> Any:
        """Train the density estimator, see :meth:`.ActionRounds.train`."""
        return super().train(*args, **kwargs)

    def _network(self, theta: Tensor, x: Tensor) -> LikelihoodNetwork:
        assert self._action_dim is not None
        return LikelihoodNetwork(self._action_estimator, x, theta, self._action_dim)

    def _train_mixture(self, config: TrainConfig, loss_args: Any) -> TrainingRecord:
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
