"""Active simulation-based inference: Algorithm 1, the belief and its updates."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from typing import Any

from sbi.inference import NPE_C
from sbi.inference.trainers.npe.npe_base import PosteriorEstimatorTrainer
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import Belief, ChainedBelief, UnchangedBelief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.networks.mixture_network import MixtureDensityNetwork
from sbi_active.inference.rounds.condition import pack
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.trainers.action_rounds import ActionRounds
from sbi_active.inference.trainers.base import is_finite_somewhere
from sbi_active.messages import warn
from sbi_active.seeding import kept_generators


class ASBI(ActionRounds, NPE_C):
    r"""Active simulation-based inference, Algorithm 1 of Kim & Matsubara (2025).

    Without ``action=`` it is sbi's :class:`~sbi.inference.NPE_C`, to the last bit at
    the same torch seed (but for a silent tracker in place of the TensorBoard one). With
    ``action=`` a round is: parameters from the current belief, actions uniform over the
    space, and a network trained from scratch on this round's rows by plain maximum
    likelihood,

    .. math::
        \min_\phi - \sum_n \log q_\phi(\theta_n | x_n, \xi_n) \qquad \text{(Eq. 9)}.

    ``build_posterior`` then gives an :class:`.ActionPosterior`, whose prior is the
    belief of the round unless another is passed.

    ``train`` then refuses ``num_atoms``, ``discard_prior_samples`` and
    ``use_combined_loss``, which have no meaning in such a round, and
    ``calibration_kernel`` for :class:`MixtureDensity`.

    ``update`` without a simulator is Step 3 of the paper, the network's value at the
    trial: :math:`b(\theta) = q(\theta | x_o, \xi^*)` within the prior's support, a
    "chained approximation". With one, the belief is "refined": the posterior of all
    trials so far given the original prior, from simulations where it is plausible
    (:func:`.refine`). That needs no network; where one was trained in this round,
    ``belief.diagnostics`` compares the two.

    NaN in x_o is information, as it is in the simulations: "no measurement" if it is
    NaN throughout, else a number that was not observed. If no simulation of this round
    lacked those numbers, the network has never seen such an outcome and its answer
    would be arbitrary. Without a simulator the belief then stays "unchanged", with a
    warning: an outcome that is rare everywhere under the belief does not say where it
    is less rare, so there is no reason to widen the belief either.

    Args:
        prior: The prior over parameters. Rounds with actions need one with a support.
        density_estimator: An sbi string or builder, or :class:`MixtureDensity`. None is
            sbi's default ("maf") without actions and ``MixtureDensity()`` with them.
        args: Further arguments of sbi's; without a tracker nothing is tracked.
        kwargs: Further arguments of sbi's by name.

    References:
        Kim & Matsubara, Applied Intelligence 2025, arXiv:2510.15331; Greenberg et al.,
        ICML 2019, arXiv:1905.07488.

    Example:
        >>> import torch
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

    _takes_partial = True

    def _train_round(self, **arguments: Any) -> ConditionalDensityEstimator:
        others = ["calibration_kernel"] if self._has_settings else []
        refused = ("discard_prior_samples", "use_combined_loss", "num_atoms", *others)
        for name in refused:
            default = signature(NPE_C.train).parameters[name].default
            value = arguments.pop(name, default)
            require(
                value == default,
                f"{name} to be left out in a round with actions, which is trained by "
                "maximum likelihood",
                value,
                "drop it",
            )
        # NPE_C.train would choose a multi-round loss here; its parent's train is plain
        # maximum likelihood on the rows that _get_start_index names.
        return PosteriorEstimatorTrainer.train(
            self, **{**arguments, "force_first_round_loss": True}
        )

    def _network(self, theta: Tensor, x: Tensor) -> MixtureDensityNetwork:
        # It does better where it knows which numbers are the action.
        return self._action_estimator.build(theta, x, self._action_dim)

    def _resolve_prior(self, prior: Any, sample_with: Any) -> Any:
        """Return the prior of a posterior: the belief of this round; sbi's hook."""
        if not self.has_actions:
            return super()._resolve_prior(prior, sample_with)
        prior = self._round_belief if prior is None else prior
        with kept_generators():  # sbi draws from the prior to look at it
            return super()._resolve_prior(prior, sample_with)

    def _model(self, estimator: Any, *arguments: Any) -> ActionPosterior:
        create: Any = NPE_C._create_posterior
        with kept_generators():
            try:
                packed = create(self, estimator, *arguments)
            except (AssertionError, NotImplementedError):
                # sbi has no transform of a mixture, nor of a prior without moments. It
                # serves the search of ``map`` alone.
                *others, parameters = arguments
                plain = replace(parameters, enable_transform=False)
                packed = create(self, estimator, *others, plain)
        assert self._action_dim is not None
        assert self._outcome_shape is not None
        return ActionPosterior(packed, self._outcome_shape, self._action_dim)

    def _learned(
        self,
        trials: Sequence[Observation],
        settings: RefinementOptions,
        seed: int | None,
        *,
        required: bool,
    ) -> Belief | None:
        """Return the network's value at the last trial.

        It is None if there is no network, or it has never seen such an outcome; if
        a belief is required, the first is an error and the second the belief before.
        """
        trial = trials[-1]
        network, previous = self._neural_net, self.belief
        if required:
            self._require_trained()
        if self._trained_round is None or network is None or previous is None:
            return None
        condition = pack(trial.x[None], trial.action[None]).to(self._device)
        prior = require_support(self._prior, enumerates=True)
        fault = _fault(network, condition, prior)
        if fault:
            if not required:
                return None
            warn(
                f"{fault[0]} the network has never seen an outcome like "
                f"{trial.x.tolist()}: {fault[1]}, so the belief is left unchanged. "
                "Refine with the simulator, simulate such outcomes as NaN, or leave "
                "the trial out where a fault caused them."
            )
            unchanged = UnchangedBelief(prior, previous)
            unchanged.diagnostics = unchanged.diagnostics.warned(" ".join(fault))
            return unchanged
        with warnings.catch_warnings():
            if not required:  # refinement repairs what the network misses
                warnings.simplefilter("ignore")
            return ChainedBelief(deepcopy(network), condition, prior, previous)


def _fault(
    network: ConditionalDensityEstimator, condition: Tensor, prior: Distribution
) -> tuple[str, str] | None:
    """Return a code and why a network can say nothing at a condition, shape (1, c)."""
    if isinstance(network, MixtureDensityNetwork):
        knows = network.knows(condition)
    else:
        knows = bool(condition.isfinite().all())  # sbi's networks take no NaN
    if not knows:
        return "SA107", "no simulation it was trained on lacks these numbers"

    def log_density(theta: Tensor) -> Tensor:
        return network.log_prob(theta.to(condition)[:, None], condition)

    if is_finite_somewhere(prior, log_density):
        return None
    return "SA113", "its density is finite nowhere"
