"""Rounds that learn a factor of the likelihood: a surrogate of it, or a ratio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch
from sbi.inference import NLE_A, NRE_C
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.beliefs.weighted import KernelBelief
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.models.factors import (
    ActionFactor,
    ActionLikelihood,
    ActionRatio,
    Product,
    sample_product,
    trained_region,
)
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.networks.likelihood_network import LikelihoodNetwork
from sbi_active.inference.networks.ratio_network import RatioClassifier, RatioNetwork
from sbi_active.inference.rounds.rows import Observation, require_whole
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.trainers.action_rounds import ActionRounds
from sbi_active.inference.trainers.base import is_finite_somewhere
from sbi_active.inference.trainers.seqbed import SeqBED_LFIRE
from sbi_active.messages import ChangedWarning, warn
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.outcomes import Simulations

SAMPLERS = ("importance", "kde")
#: Keywords of SeqBED in the last version alone.
LFIRE_KEYWORDS = {"settings", "num_particles"}


class ProductRounds(ActionRounds):
    r"""Rounds of a method that learns a factor of each trial's likelihood.

    The belief is the original prior times the product over the history, in which the
    latest network gives the factor of every trial, within the region of its training
    rows:

    .. math::
        b_r(\theta) \propto p(\theta)\, 1[\theta \in R_r]
        \prod_{k \le r} q_r(x_k | \theta, \xi_k).

    That is ``update`` without a simulator.

    Args:
        args: Arguments of :class:`.ActionRounds`.
        posterior: Sampling method for the belief: "importance", tempered importance
            sampling; or "kde", the paper's: draws of the belief before times the last
            trial's factor, as a kernel density estimate.
        kwargs: Arguments of :class:`.ActionRounds` by name.

    References:
        Papamakarios, Sterratt & Murray, AISTATS 2019 (likelihoods need no correction
        for where theta was drawn); Deistler, Goncalves & Macke, NeurIPS 2022 (keeping
        to where a network was trained).
    """

    _factor: ClassVar[type[ActionFactor]]

    def __init__(
        self, *args: Any, posterior: str = "importance", **kwargs: Any
    ) -> None:
        known = ", ".join(map(repr, SAMPLERS))
        advice = f"posterior among {known}", repr(posterior), "choose one of these"
        require(posterior in SAMPLERS, *advice)
        super().__init__(*args, **kwargs)
        self._sampler = posterior

    def _model(self, estimator: Any, *arguments: Any) -> ActionFactor:
        assert self._outcome_shape is not None
        assert self._action_dim is not None
        return self._factor(
            estimator, self._round_belief, self._outcome_shape, self._action_dim
        )

    def _learned(
        self,
        trials: Sequence[Observation],
        settings: RefinementOptions,
        seed: int | None,
        *,
        required: bool,
        num_kernels: int = 2_000,
        num_hints: int = 1_000,
    ) -> Belief | None:
        """Return the product under this round's network, where it is required.

        Args:
            trials: The history.
            settings: Settings of the belief.
            seed: Seed of all draws.
            required: Whether there must be a belief.
            num_kernels: Number of draws behind a kernel density estimate: the kernels
                of two parameters are .28 of a deviation wide, of half of them .32 and
                of twice as many .25.
            num_hints: Number of training rows that say where to look first: of these a
                mode of a hundredth of the mass has ten, of half as many five.
        """
        if not required:
            return None
        require_whole(torch.stack([trial.x for trial in trials]))
        self._require_trained()
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        prior, previous = require_support(self._prior), self._round_belief
        rng = np.random.default_rng(derive_seed(seed, "product"))
        coordinates = PriorCoordinates(prior, rng)
        region, hint = None, None
        if previous is not prior:
            rows = self.get_simulations()[0][:, : coordinates.dim].cpu()
            region = trained_region(coordinates.to_z(rows), rng)
            hint = rows[rng.permutation(len(rows))[:num_hints]]
        is_chained = self._sampler == "kde"
        learned = self._model(deepcopy(self._neural_net))
        used = trials[-1:] if is_chained else trials
        counted = [t for t in used if _says_something(learned, t, prior)]
        before = previous if is_chained and previous is not prior else None
        product = Product(coordinates, learned, counted, region, before)
        belief: Belief = sample_product(product, hint, rng, settings)
        if is_chained:
            with forked_generators(seed, "kernels"):
                belief = KernelBelief(prior, belief.sample(torch.Size([num_kernels])))
        num_lost = len(used) - len(counted)
        if num_lost:
            belief.diagnostics = belief.diagnostics.warned(
                f"SA113 {num_lost} trials are left out, at which the network's "
                "density is finite nowhere: a measurement is wrong, or the simulator "
                "lacks much"
            )
        return belief


def _says_something(
    learned: ActionFactor, trial: Observation, prior: Distribution
) -> bool:
    """Return whether the factor of a trial is finite anywhere."""

    def log_factor(theta: Tensor) -> Tensor:
        x = trial.x.expand(len(theta), *trial.x.shape)
        return learned.log_factor(theta, x, trial.action.expand(len(theta), -1))

    return is_finite_somewhere(prior, log_factor)


class ALHI(ProductRounds, NLE_A):
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

    def _stored(self, rows: Simulations) -> tuple[Tensor, Tensor]:
        return torch.cat([rows.theta, rows.action], 1), rows.x.flatten(1).clone()

    def _network(self, theta: Tensor, x: Tensor) -> LikelihoodNetwork:
        assert self._action_dim is not None
        return LikelihoodNetwork(self._action_estimator, x, theta, self._action_dim)

    def _judge(self, network: Any, *held_out: Tensor) -> None:
        network.choose(*held_out)


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
        >>> theta, action = prior.sample((300,)), torch.rand(300, 1)
        >>> x = theta * action + 0.1 * torch.randn(300, 1)
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
    _is_default: bool
    _get_losses: Callable[..., Tensor]

    def _network(self, theta: Tensor, x: Tensor) -> RatioNetwork:
        assert self._action_dim is not None
        return RatioNetwork(self._action_estimator, theta, x, self._action_dim)

    def _prepared(self, network: Any, loss_args: Any) -> Any:
        theta, x, _ = self.get_simulations()
        rows = theta.to(self._device), x.to(self._device)
        return lambda *batch: self._get_losses(batch, loss_args), rows

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make it, or what the arguments meant in the last version."""
        classifier = args[1] if len(args) > 1 else kwargs.get("classifier")
        if isinstance(classifier, LFIRE) or LFIRE_KEYWORDS & {*kwargs}:
            warn(
                "SA701 sbi_active.SeqBED of logistic regressions goes in the next "
                "version: use sbi_active.inference.SeqBED_LFIRE"
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
            )
        return super().arrange(theta, action)
