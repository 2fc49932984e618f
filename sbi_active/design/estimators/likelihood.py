"""Information gain by a learned likelihood: nested Monte Carlo and its lower bound."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
)
from sbi_active.seeding import derive_seed, forked_generators


class LikelihoodModel(Protocol):
    """Anything with a conditional density of outcomes.

    An exact likelihood, rather than a learned one, has ``exact_likelihood = True``. It
    may have ``log_likelihood_table(x, theta, action)`` as well: outcomes (n, *x_shape),
    parameters (m, theta_dim) and one action (action_dim,), all pairs of them, -> (n,
    m). A network whose condition is (theta, action) then runs m times, not n m times.
    """

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return log q(x_i | theta_i, action_i), shape (n,).

        Rows of x are NaN where there was no measurement; the log probability of that is
        then asked for.
        """
        ...


class RatioModel(Protocol):
    """Anything with a likelihood-to-marginal ratio."""

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return log q(x_i | theta_i, action_i) - log q(x_i | action_i), shape (n,).

        Rows of x are NaN where there was no measurement.
        """
        ...


@dataclass(frozen=True)
class Critic:
    r"""A function :math:`f(x, \theta | \xi)` of the model, evaluated in batches.

    Attributes:
        model: Model that was learned.
        method: Method of the model that is the function f.
        user: Name of the caller, for errors.
        batch_size: Rows in one pass.
    """

    model: Any
    method: Literal["log_likelihood", "log_ratio", "log_posterior"]
    user: str
    batch_size: int

    def __post_init__(self) -> None:
        if not hasattr(self.model, self.method):
            raise ValueError(
                f"expected a model with {self.method} for {self.user}; got "
                f"{type(self.model).__name__}; pass one that has it, or choose "
                "estimator='auto'"
            )

    def rows(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return f of every row, shape (n,), float64.

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).

        Raises:
            ValueError: If the model cannot say of a row.
        """
        evaluate = getattr(self.model, self.method)
        parts = [part.split(self.batch_size) for part in (x, theta, action)]
        values = [
            evaluate(*self._order(*batch)).double()
            for batch in zip(*parts, strict=True)
        ]
        return self._known(torch.cat(values))

    def table(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return f of every outcome with every parameter set, shape (n, m), float64.

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (m, theta_dim).
            action: One action, shape (action_dim,).
        """
        all_pairs = getattr(self.model, f"{self.method}_table", None)
        if all_pairs is not None:
            return self._known(all_pairs(*self._order(x, theta, action)).double())
        n, m = len(x), len(theta)
        values = self.rows(
            x.repeat_interleave(m, 0), theta.repeat(n, 1), action.expand(n * m, -1)
        )
        return values.reshape(n, m)

    def _order(self, x: Tensor, theta: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        if self.method == "log_likelihood":
            return x, theta, action
        return theta, x, action

    def _known(self, values: Tensor) -> Tensor:
        if bool(values.isnan().any()):
            raise ValueError(
                f"expected numbers from {type(self.model).__name__}.{self.method} for "
                f"{self.user}; got NaN in {int(values.isnan().sum())} of "
                f"{values.numel()} rows; give a model that says how probable an "
                "outcome without a measurement is, x = NaN"
            )
        return values


class LikelihoodGain(InformationGainEstimator):
    r"""Nested Monte Carlo on a likelihood, the utility of ALHI.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log q(x_i | \theta_i, \xi)
        - \log \hat p(x_i | \xi), \qquad
        \hat p(x | \xi) = \frac1L \sum_{l=1}^L q(x | \theta'_l, \xi)

    with :math:`\theta_i, \theta'_l \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. With
    the exact likelihood it is an upper bound in expectation, by Jensen's inequality,
    whose excess is about half the relative variance of :math:`\hat p`: it needs L well
    above the exponential of the information. A learned likelihood gives no bound: to
    the same excess it adds minus the divergence of the posterior that it implies.
    :class:`.NestedGain` does better on few draws where the
    noise is declared.

    Args:
        num_contrastive: Number of contrastive draws L.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    Raises:
        ValueError: If ``num_contrastive`` is below 1.

    References:
        Kim & Matsubara, Applied Intelligence 2025 (ALHI, the two equations of section
        5.1); Rainforth et al., ICML 2018 (nested Monte Carlo).

    Example:
        >>> import torch
        >>> from sbi_active.design.estimators.base import CandidateSimulations
        >>> class Scale:
        ...     exact_likelihood = True
        ...     def log_likelihood(self, x, theta, action):
        ...         normal = torch.distributions.Normal(action * theta, 1.0)
        ...         return normal.log_prob(x).sum(-1)
        >>> _ = torch.manual_seed(0)
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
        >>> theta, action = prior.sample((2_000,)), torch.tensor([[2.0], [4.0]])
        >>> x = action[:, None] * theta + torch.randn(2, 2_000, 1)
        >>> rows = CandidateSimulations(theta, action, x)
        >>> gain = LikelihoodGain()(Scale(), rows, prior).mean(1)
        >>> bool((gain - torch.tensor([0.80, 1.42])).abs().max() < 0.15)  # exact values
        True
        >>> LikelihoodGain().bound_on(Scale())
        'upper'
    """

    def __init__(
        self, *, num_contrastive: int = 500, seed: int = 0, batch_size: int = 50_000
    ) -> None:
        self.num_contrastive = at_least(num_contrastive, 1, "num_contrastive", 100)
        self.seed, self.batch_size = seed, batch_size

    @override
    def bound_on(self, model: Any) -> Bound:
        return "upper" if getattr(model, "exact_likelihood", False) else "none"

    @override
    def cautions(self, gain: Tensor) -> list[str]:
        return near_limit(
            gain,
            [math.log(self.num_contrastive)] * len(gain),
            "LikelihoodGain is near log L = {limit} or above at {where}: few of the "
            "draws explain an outcome, and it is too large there; raise "
            "num_contrastive",
        )

    def _terms(self, own: Tensor, contrastive: Tensor) -> Tensor:
        """Return the log likelihoods whose mean is the evidence, (n, L) or (n, L + 1).

        Of log q(x_i | theta_i), shape (n,), and log q(x_i | theta'_l), shape (n, L).
        """
        return contrastive

    def _contributions(
        self,
        model: LikelihoodModel,
        simulations: CandidateSimulations,
        belief: Distribution | None,
    ) -> Tensor:
        user = type(self).__name__
        critic = Critic(model, "log_likelihood", user, self.batch_size)
        theta = self._draw(belief, simulations)
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        for a, counted in enumerate(simulations.counted):
            if bool(counted.any()):
                of_each = [
                    self._of_rows(
                        critic,
                        x[a, counted],
                        simulations.theta[counted],
                        theta,
                        simulations.action[a],
                    )
                    for x in simulations.outcomes()
                ]
                gain[a, counted] = torch.stack(of_each).mean(0)
        return gain

    def _of_rows(
        self, critic: Critic, x: Tensor, theta: Tensor, others: Tensor, action: Tensor
    ) -> Tensor:
        """Contributions of one candidate's outcomes, shape (n,)."""
        n, m = len(x), len(others)
        own = critic.rows(x, theta, action.expand(n, -1))
        log_p = torch.empty(n, dtype=torch.float64)
        share = torch.zeros(m, dtype=torch.float64)  # in the evidences of all outcomes
        for block in torch.arange(n).split(max(64, self.batch_size // m)):
            terms = self._terms(own[block], critic.table(x[block], others, action))
            log_p[block] = log_mean(terms)
            share += terms.softmax(1)[:, -m:].nan_to_num(0.0).sum(0)
        effect = torch.zeros(n, dtype=torch.float64)
        effect.index_add_(0, torch.arange(m) % n, share - share.mean())
        gain = torch.where(own == -torch.inf, own, own - log_p)
        return gain - effect

    def _draw(
        self, belief: Distribution | None, simulations: CandidateSimulations
    ) -> Tensor:
        if belief is None:
            raise ValueError(
                f"expected a belief for {type(self).__name__} to draw from; got None; "
                "pass the distribution of theta in the simulations"
            )
        key = zlib.crc32(simulations.theta.numpy(force=True).tobytes())
        with forked_generators(derive_seed(self.seed, "contrastive", key)):
            return belief.sample(torch.Size([self.num_contrastive]))


def log_mean(terms: Tensor) -> Tensor:
    """Return the log of the mean of exp(terms), (n, k) -> (n,)."""
    return terms.logsumexp(1) - math.log(terms.shape[1])


def near_limit(
    gain: Tensor, limits: Sequence[float], text: str, *, near: float = 1.0
) -> list[str]:
    """Return a caution where estimates are near a limit or above it; none elsewhere.

    Args:
        gain: Contributions, shape (a, n).
        limits: Limit of each action, nats.
        text: The caution, with {limit} and {where}.
        near: Distance to the limit, the log of a number of draws, within which too few
            are effective, nats.
    """
    mean = gain.nanmean(1)
    num = int((mean > torch.tensor(limits, dtype=mean.dtype) - near).sum())
    where = f"{num} of {len(gain)} actions"
    return [text.format(limit=f"{max(limits):.1f} nats", where=where)] if num else []


class ContrastiveGain(LikelihoodGain):
    r"""Prior contrastive estimation (PCE).

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log q(x_i | \theta_i, \xi)
        - \log \hat p_i(x_i | \xi), \qquad
        \hat p_i(x | \xi) = \frac{1}{L + 1} \left[ q(x | \theta_i, \xi)
        + \sum_{l=1}^L q(x | \theta'_l, \xi) \right]

    with :math:`\theta_i, \theta'_l \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. It
    tells :math:`\theta_i` from L others by x and is a lower bound for any positive
    function q, so on simulations that q was not trained on a learned likelihood keeps
    it below the information, if not close. With the exact one it rises to the
    information with L. It cannot exceed log(L + 1), near which it does not rank.

    Args:
        num_contrastive: Number of contrastive draws L.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    References:
        Foster, Jankowiak, O'Meara, Teh & Rainforth, AISTATS 2020; van den Oord, Li &
        Vinyals, 2018 (the bound for any critic).
    """

    bound: Bound = "lower"

    @override
    def bound_on(self, model: Any) -> Bound:
        return self.bound

    def _terms(self, own: Tensor, contrastive: Tensor) -> Tensor:
        return torch.cat([own[:, None], contrastive], 1)

    @override
    def cautions(self, gain: Tensor) -> list[str]:
        return near_limit(
            gain,
            [math.log(self.num_contrastive + 1)] * len(gain),
            "ContrastiveGain is near its largest value, log(L + 1) = {limit}, at "
            "{where}: it is too small there and does not rank; raise num_contrastive",
        )
