"""Active simulation-based inference: Algorithm 1, the belief and its updates."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any, Literal

from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimatorBuilder,
)
from sbi.sbi_types import Tracker
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.action_npe import ActionNPE
from sbi_active.inference.belief import Belief, ChainedBelief, require_support
from sbi_active.inference.condition import action_rows, outcome_rows, pack
from sbi_active.inference.rounds import Observation

__all__ = ["ASBI"]


class ASBI(ActionNPE):
    r"""Active simulation-based inference, Algorithm 1 of Kim & Matsubara (2025).

    Without ``action=`` it is sbi's :class:`~sbi.inference.NPE_C`, to the last bit at
    the same torch seed (but for a silent tracker in place of the TensorBoard one). With
    ``action=`` a round is: parameters from the current belief, actions uniform over the
    space, and a network trained from scratch on this round's rows by plain maximum
    likelihood,

    .. math::
        \min_\phi - \sum_n \log q_\phi(\theta_n | x_n, \xi_n) \qquad \text{(Eq. 9)},

    whose value at the observed trial is the next belief.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        density_estimator: An sbi string or builder, or :class:`MixtureDensity`. None is
            sbi's default ("maf") without actions and ``MixtureDensity()`` with them.
        device: Of the network, for example "cpu" or "cuda".
        logging_level: As in sbi.
        summary_writer: As in sbi (deprecated there).
        tracker: As in sbi; None tracks nothing, so that no folder appears.
        show_progress_bars: Whether sbi's training loop shows its epochs.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331; Greenberg et al.,
        ICML 2019, arXiv:1905.07488.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(-torch.ones(1), torch.ones(1))
        >>> theta, action = prior.sample((500,)), torch.rand(500, 1)
        >>> x = theta * action + 0.1 * torch.randn(500, 1)
        >>> settings = MixtureDensity(num_iterations=50)
        >>> inference = ASBI(prior, settings, show_progress_bars=False)
        >>> _ = inference.append_simulations(theta, x, action=action).train()
        >>> belief = inference.update(torch.tensor([0.3]), action=torch.tensor([0.6]))
        >>> belief.sample((3,)).shape
        torch.Size([3, 1])
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
            prior,
            density_estimator,
            device,
            logging_level,
            summary_writer,
            tracker,
            show_progress_bars,
        )
        self.trials: list[Observation] = []

    def update(
        self,
        x_o: Tensor,
        *,
        action: Tensor,
        simulator: Callable[..., Any] | None = None,
    ) -> Belief:
        r"""Return the belief after a real trial, and make it the current one.

        Without a simulator this is Step 3 of the paper, the network's value at the
        trial: :math:`b(\theta) = q(\theta | x_o, \xi^*)` within the prior's support.

        Args:
            x_o: The observed outcome, shape x_shape or (1, *x_shape).
            action: The executed action, shape (action_dim,) or (1, action_dim); it need
                not be one of the actions that were asked for.
            simulator: Not used yet.

        Returns:
            The belief, labelled "chained approximation".

        Raises:
            RuntimeError: If no network was trained since the belief last changed.
            ValueError: If shapes do not fit, or x_o has no measurement and no
                simulation of this round had none either.
        """
        if simulator is not None:
            raise NotImplementedError("refinement")
        network, previous = self._neural_net, self.belief
        if self._trained_round is None or network is None or previous is None:
            raise RuntimeError(
                "expected a network trained under the current belief; got none since "
                "the last update() or append_simulations(); do append simulations of "
                "the belief with action= and train() first"
            )
        prior = require_support(self._prior)
        assert self._outcome_shape is not None
        x_row = outcome_rows(x_o, self._outcome_shape)
        row = action_rows(action, self._action_dim, num_rows=1)
        if len(x_row) != 1:
            raise ValueError(
                f"expected one outcome; got {len(x_row)} rows; do update with one "
                "trial at a time"
            )
        self._require_known(x_row, network)
        condition = pack(x_row, row).to(self._device)
        belief = ChainedBelief(deepcopy(network), condition, prior, previous)
        self.trials.append(Observation(row[0], x_row[0]))
        self._belief, self._trained_round = belief, None
        return belief

    @staticmethod
    def _require_known(x: Tensor, network: ConditionalDensityEstimator) -> None:
        """Raise where x has no measurement and the network never saw that."""
        if bool(x.isfinite().all()) or getattr(network, "knows_invalid", False):
            return
        raise ValueError(
            f"expected an outcome with a measurement; got {x.flatten().tolist()}, and "
            "no simulation of this round had NaN, so the network knows nothing of it; "
            "do leave the trial out, or simulate invalid outcomes as NaN"
        )
