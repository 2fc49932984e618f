"""Active simulation-based inference: Algorithm 1, the belief and its updates."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
)
from torch import Tensor

from sbi_active.inference.action_npe import ActionNPE
from sbi_active.inference.belief import Belief, ChainedBelief, require_support
from sbi_active.inference.comparison import compare
from sbi_active.inference.condition import action_rows, outcome_rows, pack
from sbi_active.inference.refine import Refinement, refine
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
        >>> from sbi_active import MixtureDensity
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

    def update(
        self,
        x_o: Tensor,
        *,
        action: Tensor,
        simulator: Callable[..., Any] | None = None,
        refinement: Refinement | None = None,
        seed: int | None = None,
    ) -> Belief:
        r"""Return the belief after a real trial, and make it the current one.

        Without a simulator this is Step 3 of the paper, the network's value at the
        trial: :math:`b(\theta) = q(\theta | x_o, \xi^*)` within the prior's support.
        With one, the belief is refined: the posterior of all trials so far given the
        original prior, from simulations where it is plausible
        (:func:`~sbi_active.inference.refine.refine`). That needs no network; where one
        was trained in this round, ``belief.diagnostics`` compares the two.

        Args:
            x_o: The observed outcome, shape x_shape or (1, *x_shape).
            action: The executed action, shape (action_dim,) or (1, action_dim); it need
                not be one of the actions that were asked for.
            simulator: ``simulator(theta, action)`` to refine with.
            refinement: Settings of the refinement; None is ``Refinement()``.
            seed: Of the refinement; None draws one from torch's global generator.

        Returns:
            The belief, labelled "refined" or "chained approximation".

        Raises:
            RuntimeError: If there is no simulator and no network was trained since the
                belief last changed.
            ValueError: If shapes do not fit, or x_o has no measurement and no
                simulation of this round had none either.
        """
        trial = self._observation(x_o, action)
        finite = bool(trial.x.isfinite().all())
        needs_network = simulator is None or not finite
        chained = self._chained(trial, required=needs_network)
        if simulator is None or not finite:
            assert chained is not None
            belief: Belief = chained
        else:
            trials = [*self.trials, trial]
            belief = self._refined(trials, simulator, chained, refinement, seed)
        self.trials.append(trial)
        self._belief, self._trained_round = belief, None
        return belief

    def update_all(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any],
        *,
        refinement: Refinement | None = None,
        seed: int | None = None,
    ) -> Belief:
        """Return the refined belief of these trials alone, computed from scratch.

        Args:
            trials: They replace the history.
            simulator: As in :meth:`update`.
            refinement: As in :meth:`update`.
            seed: As in :meth:`update`.

        Raises:
            ValueError: If no trial has a measurement.
        """
        belief = self._refined(
            [*trials], simulator, None, refinement, seed, reuse=False
        )
        self.trials = [*trials]
        self._belief, self._trained_round = belief, None
        return belief

    def _observation(self, x_o: Tensor, action: Tensor) -> Observation:
        """Return the checked trial."""
        x = torch.as_tensor(x_o, dtype=torch.float32)
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

    def _chained(self, trial: Observation, *, required: bool) -> ChainedBelief | None:
        """Return the network's value at the trial, None where there is no network."""
        network, previous = self._neural_net, self.belief
        if self._trained_round is None or network is None or previous is None:
            if not required:
                return None
            raise RuntimeError(
                "expected a network trained under the current belief; got none since "
                "the last update() or append_simulations(); do append simulations of "
                "the belief with action= and train() first"
            )
        if required:
            self._require_known(trial.x, network)
        condition = pack(trial.x[None], trial.action[None]).to(self._device)
        prior = require_support(self._prior)
        with warnings.catch_warnings():
            if not required:  # refinement repairs what the network misses
                warnings.simplefilter("ignore")
            return ChainedBelief(deepcopy(network), condition, prior, previous)

    def _refined(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any],
        chained: ChainedBelief | None,
        refinement: Refinement | None,
        seed: int | None,
        *,
        reuse: bool = True,
    ) -> Belief:
        measured = [t for t in trials if bool(t.x.isfinite().all())]
        if not measured:
            raise ValueError(
                f"expected a trial with a measurement; got {len(trials)} without; do "
                "update with the trained network, which can use invalid outcomes"
            )
        belief = refine(
            simulator,
            require_support(self._prior),
            torch.stack([t.action for t in measured]),
            torch.stack([t.x for t in measured]),
            start=chained,
            past=getattr(self._belief, "histories", None) if reuse else None,
            settings=refinement,
            seed=int(torch.randint(2**62, ())) if seed is None else seed,
        )
        belief.diagnostics["trials_left_out"] = len(trials) - len(measured)
        if chained is not None:
            compare(belief, chained)
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
