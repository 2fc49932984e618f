r"""Information gain by a learned posterior, likelihood or ratio.

Every estimate here is the mean of :math:`f(x_i, \theta_i)`, a function of the model,
less the log density of what it is compared with: of the parameters where f is a
posterior's, of the outcome by other parameters where it is a likelihood's, and of
nothing where it is a ratio.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
    standard_error,
)
from sbi_active.expected import require
from sbi_active.seeding import derive_seed, forked_generators


class _Critic(InformationGainEstimator):
    r"""Estimator by a function :math:`f(x, \theta | \xi)` of the model, in batches.

    Attributes:
        functions: Methods of a model that may be f, the first that it has.
        batch_size: Rows in one pass of the network.
    """

    functions: ClassVar[tuple[str, ...]] = ("log_ratio",)
    batch_size: int = 50_000

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Any
    ) -> Tensor:
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        others = self._others(simulations, belief)
        for a, counted in enumerate(simulations.counted):
            rows, action = torch.nonzero(counted)[:, 0], simulations.action[a]
            if len(rows):
                given = simulations.theta[rows], others, action
                every = [x[a, rows] for x in simulations.outcomes()]
                each = [self._of_rows(model, x, *given) for x in every]
                gain[a, rows] = torch.stack(each).mean(0)
        return gain

    def _others(self, simulations: CandidateSimulations, belief: Any) -> Tensor:
        """Return the parameters that outcomes are compared with, (m, d)."""
        return simulations.theta[:0]

    def _of_rows(
        self, model: Any, x: Tensor, theta: Tensor, others: Tensor, action: Tensor
    ) -> Tensor:
        """Return contributions of outcomes (n, *x_shape) of one candidate, (n,)."""
        name = self._function(model)
        rows = _ordered(name, x, theta, action.expand(len(x), -1))
        batches = zip(*(part.split(self.batch_size) for part in rows), strict=True)
        return torch.cat([getattr(model, name)(*batch).double() for batch in batches])

    def _table(self, model: Any, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return f of every x (n, ...) with every theta (m, d) at one action, (n, m).

        A model may have it as a method ``log_likelihood_table(x, theta, action)``: a
        network whose condition is (theta, action) then runs m times, not n m times.
        """
        name = self._function(model)
        all_pairs = getattr(model, f"{name}_table", None)
        if all_pairs is not None:
            return all_pairs(*_ordered(name, x, theta, action)).double()
        n, m = len(x), len(theta)
        every = x.repeat_interleave(m, 0), theta.repeat(n, 1)
        return _Critic._of_rows(self, model, *every, theta, action).reshape(n, m)

    def _function(self, model: Any) -> str:
        known = [name for name in self.functions if hasattr(model, name)]
        expected = f"a model with {self.functions[-1]} for {type(self).__name__}"
        advice = "pass one that has it, or choose estimator='auto'"
        require(bool(known), expected, type(model).__name__, advice)
        return known[0]


def _ordered(
    name: str, x: Tensor, theta: Tensor, action: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the arguments in the order of a model's method."""
    return (x, theta, action) if name == "log_likelihood" else (theta, x, action)


class PosteriorGain(_Critic):
    r"""Barber-Agakov bound, the utility of ASBI.

    .. math::
        U(\xi) = \frac{1}{M} \sum_{i=1}^M
        \log q(\theta_i | x_i, \xi) - \log p(\theta_i)
        \qquad \text{(Eqs. 12-13)}

    with :math:`\theta_i \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. For any q,
    :math:`E[U(\xi)] = I(\theta; x | \xi) - E[\mathrm{KL}(p(\theta | x, \xi) \| q)]`,
    so on simulations that q was not trained on it is a lower bound. Its slack differs
    by action: ranking by it is not ranking by information where q is blunter for one
    action than for another. Outcomes at the same parameters are averaged, as they are
    not independent.

    The model has ``log_posterior(theta, x, action)``, the log density of every row,
    shape (n,).

    References:
        Kim & Matsubara, Applied Intelligence 2025; Barber & Agakov, NeurIPS 2003.
    """

    bound: Bound = "lower"
    functions = ("log_posterior",)

    @override
    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        density = getattr(belief, "smooth_log_prob", belief.log_prob)
        log_q = super()._contributions(model, simulations, belief)
        return log_q - density(simulations.theta)


class RatioGain(_Critic):
    r"""Mean log ratio of likelihood to marginal, the utility of LFIRE.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log r(x_i, \theta_i | \xi), \qquad
        r(x, \theta | \xi) \approx \frac{p(x | \theta, \xi)}{p(x | \xi)}

    with :math:`\theta_i \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. With the exact
    ratio it has no bias, however large the information; a learned one gives no bound,
    as nothing makes its normalization right. Where a network leaves it open
    (multi-class ratio estimation does, up to a function of x) take
    :class:`.InfoNCEGain`.

    The model has ``log_ratio(theta, x, action)``, :math:`\log q(x_i | \theta_i, \xi_i)
    - \log q(x_i | \xi_i)` of every row, shape (n,). Rows of x are NaN where there was
    no measurement.

    Attributes:
        negligible: Difference to InfoNCE that counts beyond four standard errors, nats.

    References:
        Thomas, Dutta, Corander, Kaski & Gutmann, Bayesian Analysis 2022 (LFIRE);
        Kleinegesse, Drovandi & Gutmann, Bayesian Analysis 2021 (the utility).
    """

    negligible: ClassVar[float] = 0.3

    @override
    def compared(
        self, model: Any, simulations: CandidateSimulations, belief: Any, gain: Tensor
    ) -> list[str]:
        """Return a caution where InfoNCE, which needs no normalization, is elsewhere.

        Args:
            model: Model with ``log_ratio``.
            simulations: Simulations that the contributions are of.
            belief: Belief that theta was drawn from.
            gain: Contributions, shape (a, n).
        """
        other = InfoNCEGain()
        bound = other(model, simulations, belief)
        error = standard_error(bound - gain)
        apart = (bound - gain).nanmean(1).abs() - self.negligible - 4 * error
        worst = int(apart.nan_to_num(nan=-torch.inf).argmax())
        if not bool(apart[worst] > 0) or other.cautions(bound):
            return []
        off = float((bound - gain)[worst].nanmean())
        return [
            f"InfoNCEGain is {abs(off):.1f} nats {'below' if off < 0 else 'above'} at "
            f"action {simulations.action[worst].tolist()}: the ratio is not normalized"
        ]


class LikelihoodGain(_Critic):
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

    The model has ``log_likelihood(x, theta, action)``, the log density of every row,
    shape (n,), of x that may be NaN where there was no measurement;
    ``exact_likelihood = True`` where it is not learned.

    Args:
        num_contrastive: Number of contrastive draws L.

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

    functions = ("log_likelihood",)
    caution: ClassVar[str] = (
        "LikelihoodGain is near log L = {limit} or above at {where}: few of the draws "
        "explain an outcome, and it is too large there; raise num_contrastive"
    )
    own: ClassVar[int] = 0

    def __init__(self, *, num_contrastive: int = 500) -> None:
        self.num_contrastive = at_least(num_contrastive, 1, "num_contrastive", 100)

    @override
    def bound_on(self, model: Any) -> Bound:
        exact = getattr(model, "exact_likelihood", False)
        return "upper" if exact and not self.own else self.bound

    @override
    def _others(
        self, simulations: CandidateSimulations, belief: Distribution | None
    ) -> Tensor:
        if belief is None:
            raise ValueError(
                f"expected a belief for {type(self).__name__}; got None; pass that "
                "which the parameters were drawn from"
            )
        key = zlib.crc32(simulations.theta.numpy(force=True).tobytes())
        with forked_generators(derive_seed(0, "contrastive", key)):
            return belief.sample(torch.Size([self.num_contrastive]))

    @override
    def _of_rows(
        self, model: Any, x: Tensor, theta: Tensor, others: Tensor, action: Tensor
    ) -> Tensor:
        """Return contributions, with what others do to the evidence of outcomes.

        This has mean zero and makes the error honest.
        """
        n, m = len(x), len(others)
        own = super()._of_rows(model, x, theta, others, action)
        log_p = torch.empty(n, dtype=torch.float64)
        share = torch.zeros(m, dtype=torch.float64)  # in the evidences of all outcomes
        for block in torch.arange(n).split(max(64, self.batch_size // m)):
            table = self._table(model, x[block], others, action)
            if self.own:
                table = torch.cat([table, own[block, None]], 1)
            log_p[block] = table.logsumexp(1) - math.log(m + self.own)
            share += table.softmax(1).nan_to_num(0.0)[:, :m].sum(0)
        effect = torch.zeros(n, dtype=torch.float64)
        effect.index_add_(0, torch.arange(m) % n, share - share.mean())
        return torch.where(own == -torch.inf, own, own - log_p) - effect

    @override
    def cautions(self, gain: Tensor, *, near: float = 1.0) -> list[str]:
        """Return a caution where estimates are near their limit or above it.

        Args:
            gain: Contributions, shape (a, n).
            near: Distance to the log of a number of draws, within which too few are
                effective, nats.
        """
        limit = math.log(self.num_contrastive + self.own)
        above = int((gain.nanmean(1) > limit - near).sum())
        where = f"{above} of {len(gain)} actions"
        found = self.caution.format(limit=f"{limit:.1f} nats", where=where)
        return [found] if above else []


class InfoNCEGain(LikelihoodGain):
    r"""InfoNCE bound with a learned ratio or likelihood as its critic.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log \frac{e^{f(x_i, \theta_i | \xi)}}
        {\frac1{L + 1} \left[ e^{f(x_i, \theta_i | \xi)} +
        \sum_{l=1}^L e^{f(x_i, \theta'_l | \xi)} \right]}

    with :math:`\theta_i, \theta'_l \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`, and
    f the model's ``log_ratio``, or else its ``log_likelihood``. It is a lower bound for
    any f, on simulations that f was not trained on, and does not change where f is off
    by a function of x. It cannot exceed log (L + 1), near which it does not rank.

    Args:
        num_contrastive: Number of contrastive draws L.

    Raises:
        ValueError: If ``num_contrastive`` is below 1.

    References:
        van den Oord, Li & Vinyals, 2018; Poole et al., ICML 2019 (bounds of mutual
        information).
    """

    bound: Bound = "lower"
    functions = ("log_ratio", "log_likelihood")
    caution = (
        "InfoNCEGain is near its largest value, log K = {limit}, at {where}: it is too "
        "small there and does not rank; raise num_contrastive"
    )
    own = 1

    def __init__(self, *, num_contrastive: int = 127) -> None:
        super().__init__(num_contrastive=num_contrastive)
