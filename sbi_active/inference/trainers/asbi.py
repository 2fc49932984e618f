"""Active simulation-based inference: Algorithm 1, the belief and its updates."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from typing import Any

import torch
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
)
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import (
    Belief,
    ChainedBelief,
    UnchangedBelief,
    require_support,
)
from sbi_active.inference.beliefs.comparison import compare
from sbi_active.inference.networks.mixture_density import MixtureDensityNetwork
from sbi_active.inference.refinement.learned_belief import RefinedBelief
from sbi_active.inference.refinement.stages import Refinement, refine
from sbi_active.inference.rounds.condition import pack
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.trainers.action_npe import ActionNPE
from sbi_active.seeding import forked_generators, kept_generators

__all__ = ["ASBI"]

NUM_PROBES = 64  # draws of the prior, at one of which a network has a finite density


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
        (:func:`.refine`). That needs no network; where one
        was trained in this round, ``belief.diagnostics`` compares the two.

        NaN in x_o is information, as it is in the simulations: "no measurement" where
        it is NaN throughout, else a number that was not observed. Where no simulation
        of this round lacked those numbers, the network has never seen such an outcome
        and what it would say is arbitrary. Without a simulator the belief then stays
        as it is, with a warning: that the outcome is rare all over the belief says
        nothing about where it is less rare, so there is no reason to widen it either.

        Args:
            x_o: The observed outcome, shape x_shape or (1, *x_shape); NaN where there
                was no measurement.
            action: The executed action, shape (action_dim,) or (1, action_dim); it need
                not be one of the actions that were asked for.
            simulator: ``simulator(theta, action)`` to refine with.
            refinement: Settings of the refinement; None is ``Refinement()``.
            seed: Of the refinement; None draws one from torch's global generator.

        Returns:
            The belief, labelled "refined", "chained approximation" or "unchanged".

        Raises:
            RuntimeError: If there is no simulator and no network was trained since the
                belief last changed.
            ValueError: If shapes do not fit.
        """
        trial = self._observation(x_o, action)
        with nullcontext() if seed is None else kept_generators():
            chained = self._chained(trial, required=simulator is None)
        if simulator is None:
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
        """
        belief = self._refined(
            [*trials], simulator, None, refinement, seed, reuse=False
        )
        self.trials = [*trials]
        self._belief, self._trained_round = belief, None
        return belief

    def _chained(self, trial: Observation, *, required: bool) -> Belief | None:
        """Return the network's value at the trial.

        It is None where there is no network, or it has never seen such an outcome; if
        a belief is required, the first is an error and the second the belief before.
        """
        network, previous = self._neural_net, self.belief
        if required:
            self._require_belief_network()
        if self._trained_round is None or network is None or previous is None:
            return None
        condition = pack(trial.x[None], trial.action[None]).to(self._device)
        prior = require_support(self._prior)
        fault = _fault(network, condition, prior)
        if fault:
            if not required:
                return None
            warnings.warn(
                f"the network has never seen an outcome like {trial.x.tolist()}: "
                f"{fault}, so the belief is left unchanged. Refine with the simulator, "
                "simulate such outcomes as NaN, or leave the trial out where a fault "
                "caused them.",
                stacklevel=3,
            )
            unchanged = UnchangedBelief(prior, previous)
            unchanged.diagnostics = unchanged.diagnostics.warned(fault)
            return unchanged
        with warnings.catch_warnings():
            if not required:  # refinement repairs what the network misses
                warnings.simplefilter("ignore")
            return ChainedBelief(deepcopy(network), condition, prior, previous)

    def _refined(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any],
        chained: Belief | None,
        refinement: Refinement | None,
        seed: int | None,
        *,
        reuse: bool = True,
    ) -> Belief:
        previous = self._belief if reuse else None
        # A chained belief can be wrong; the refined one before the trial holds the
        # posterior, if only it is wide enough.
        start = [] if chained is None else [chained]
        if isinstance(previous, RefinedBelief):
            start.append(previous)
        belief = refine(
            simulator,
            require_support(self._prior),
            torch.stack([t.action for t in trials]),
            torch.stack([t.x for t in trials]),
            start=start,
            past=getattr(previous, "histories", None),
            settings=refinement,
            seed=int(torch.randint(2**62, ())) if seed is None else seed,
        )
        if isinstance(chained, ChainedBelief):
            compare(belief, chained)
        return belief


def _fault(
    network: ConditionalDensityEstimator, condition: Tensor, prior: Distribution
) -> str:
    """Return why a network cannot say anything at a condition, shape (1, c); or ""."""
    if isinstance(network, MixtureDensityNetwork):
        knows = network.knows(condition)
    else:
        knows = bool(condition.isfinite().all())  # sbi's networks take no NaN
    if not knows:
        return "no simulation it was trained on lacks these numbers"
    with forked_generators(0), torch.no_grad():
        theta = prior.sample(torch.Size([NUM_PROBES])).to(condition)
        density = network.log_prob(theta[:, None], condition)
    # Beyond 1e19, float32 has no squares.
    return "" if bool(density.isfinite().any()) else "its density is finite nowhere"
