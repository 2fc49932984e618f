"""ASBI whose updates average over denoised outcomes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief, ChainedBelief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.networks.mixture_network import MixtureDensityNetwork
from sbi_active.inference.rounds.condition import pack
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.trainers.asbi import ASBI
from sbi_active.pyro.denoising import Denoised, SpikeAndSlab, denoise
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate


class RobustBelief(ChainedBelief):
    r"""The network's posterior, averaged over denoised outcomes.

    .. math::
        b(\theta) = \frac1n \sum_i q(\theta | x_i, \xi)\,
        1[\theta \in \mathrm{supp}\, p] / Z, \qquad x_i \sim p(x | x_o)

    Args:
        estimator: Estimator q over packed conditions.
        condition: Conditions (x_i, action), shape (n, condition_dim).
        prior: The original prior.
        previous: The belief before the trial.
        denoised: Denoised outcomes that it was drawn with.
    """

    label = "robust, chained approximation"

    def __init__(
        self,
        estimator: Any,
        condition: Tensor,
        prior: Distribution,
        previous: Distribution,
        denoised: Denoised,
    ) -> None:
        with forked_generators(0, "robust"):
            super().__init__(estimator, condition, prior, previous)
        self.denoised = denoised
        self.diagnostics = self.diagnostics.extended(
            misspecification=denoised.probability.tolist(),
            gibbs_r_hat=denoised.r_hat,
            gibbs_effective_draws=denoised.effective_sample_size,
        )

    def _raw(self, num: int) -> Tensor:
        each = -(-num // len(self._condition))
        draws = self._estimator.sample(torch.Size([each]), self._condition)
        draws = draws.flatten(0, 1)
        return draws[torch.randperm(len(draws))[:num]]

    def _log_density(self, theta: Tensor) -> Tensor:
        num, found = len(self._condition), [theta.new_zeros(0).double()]
        with torch.no_grad():
            for rows in theta.split(2_000):
                each = rows[:, None].expand(-1, num, -1)
                log_q = self._estimator.log_prob(each, self._condition)
                found.append(log_q.double().logsumexp(1))
        return torch.cat(found) - math.log(num)


class RobustASBI(ASBI):
    r"""ASBI that is robust to errors of an outcome.

    A trial's outcome is denoised with the error model and the predictive under the
    belief before it, and the belief becomes the network's posterior averaged over
    denoised outcomes. The simulator, which :meth:`update` needs, is only used for the
    predictive, and nothing is refined: the result is a chained approximation as that of
    :class:`ASBI` without one.

    Args:
        prior: Prior of the parameters; it and all that follows are those of
            :class:`ASBI`.
        error_model: p(x_o | x); None is :class:`SpikeAndSlab`.
        num_predictive: Number of simulations under the belief before the trial.
        num_averaged: Number of denoised outcomes.

    Attributes:
        denoised: Denoised outcome of each update.
    """

    def __init__(
        self,
        prior: Any = None,
        *args: Any,
        error_model: Any = None,
        num_predictive: int = 1_000,
        num_averaged: int = 100,
        **kwargs: Any,
    ) -> None:
        super().__init__(prior, *args, **kwargs)
        self.error_model = SpikeAndSlab() if error_model is None else error_model
        self.num_predictive, self.num_averaged = num_predictive, num_averaged
        self.denoised: list[Denoised] = []

    def _inferred(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any] | None,
        settings: RefinementOptions,
        seed: int | None,
        *,
        afresh: bool,
    ) -> Belief:
        """Return the belief after a further trial, see :meth:`.ActiveInference.update`.

        NaN in an outcome is information where simulations of this round lacked those
        numbers too; else their sensor failed, and they are drawn from what the
        predictive says given the others.
        """
        if simulator is None or afresh:
            raise ValueError(
                "expected a simulator, whose predictive tells what an outcome may be, "
                f"and trials one by one; got simulator={simulator} and {len(trials)} "
                "trials; pass the simulator to update()"
            )
        self._require_trained()
        network, previous, trial = self._neural_net, self.belief, trials[-1]
        assert previous is not None
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        with forked_generators(seed, "predictive"):
            theta = previous.sample(torch.Size([self.num_predictive]))
        actions = trial.action.expand(self.num_predictive, -1)
        rows = simulate(simulator, theta, actions, seed=derive_seed(seed, "rows"))
        flat, x_o = rows.x.reshape(len(rows.x), -1), trial.x.reshape(-1)
        # A number that simulations lack too is information; else its sensor failed.
        lacking = missing = x_o.isnan()
        condition = pack(trial.x[None], trial.action[None])
        is_ours = isinstance(network, MixtureDensityNetwork)
        if not (is_ours and network.knows(condition)):
            lacking = torch.zeros_like(missing)
        rows_alike = (flat.isnan() == lacking).all(1) & ~flat.isinf().any(1)
        flat = torch.where(lacking, 0.0, flat[rows_alike])
        denoised = denoise(x_o, flat, self.error_model, seed=derive_seed(seed, "gibbs"))
        pick = torch.linspace(0, len(denoised.x) - 1, self.num_averaged).long()
        x = torch.where(lacking, torch.nan, denoised.x[pick].float())
        x = x.reshape(len(pick), *trial.x.shape)
        condition = pack(x, trial.action.expand(len(pick), -1)).to(self._device)
        prior = require_support(self._prior)
        self.denoised.append(denoised)
        return RobustBelief(deepcopy(network), condition, prior, previous, denoised)
