"""The belief: what is known about the parameters after the trials so far."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import torch
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.display.notebook import card, table
from sbi_active.display.table import Table
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.messages import warn
from sbi_active.plain import with_error
from sbi_active.seeding import forked_generators
from sbi_active.support import parameter_dim, support_of, within_support


class Belief(Distribution, ABC):
    r"""Distribution over the parameters after zero or more trials.

    It is a torch distribution in float32 with an empty batch shape, the support of the
    original prior and a normalized ``log_prob``, so that it can be the prior of the
    next round, and of anything else that takes a prior.

    Args:
        prior: The original prior, which gives the support.

    Attributes:
        prior: The original prior.
        label: Label that says how the belief was made, for reports.
        parameter_names: Names of the parameters, where the simulator names them; else
            None.
        num_draws: Number of draws behind moments and a chained belief's normalizer:
            they are known to a hundredth of a deviation.
        diagnostics: Diagnostics of its quality.
    """

    arg_constraints = {}  # pyright: ignore
    num_draws: ClassVar[int] = 20_000
    label: str = "belief"
    parameter_names: tuple[str, ...] | None = None

    def __init__(self, prior: Distribution) -> None:
        dim = parameter_dim(prior)
        super().__init__(torch.Size(), torch.Size([dim]), validate_args=False)
        self.prior = prior
        self.diagnostics = Diagnostics()

    @abstractmethod
    def _sample(self, num_samples: int) -> Tensor:
        """Return draws, shape (n, theta_dim), from torch's global generator."""

    def _typical(self, num_samples: int) -> Tensor:
        """Return draws without a share that guards against errors of the belief."""
        return self._sample(num_samples)

    @abstractmethod
    def _log_prob(self, theta: Tensor) -> Tensor:
        """Return the normalized log density inside the support, (n, d) -> (n,)."""

    @property
    @override
    def support(self) -> Any:
        return support_of(self.prior)

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        """Return draws, shape (*sample_shape, theta_dim), float32."""
        shape = torch.Size(sample_shape)
        with torch.no_grad():
            draws = self._sample(shape.numel()).float()
            return draws.reshape(*shape, *self.event_shape)

    def quick_sample(self, num_samples: int = 2_000, *, seed: int) -> Tensor:
        """Return draws of a seed of their own, (n, theta_dim), for moments and tables.

        They are of the posterior alone: of the prior's share in a belief, which keeps
        its density from 0, one draw would outweigh a sharp posterior's deviation.

        Args:
            num_samples: Number of draws n.
            seed: Seed of the draws.

        Returns:
            Shape (n, theta_dim), float32.
        """
        with forked_generators(seed), torch.no_grad():
            return self._typical(num_samples).float()

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, (..., theta_dim) -> (...); -inf off the support."""
        return self._by_rows(self._log_prob, value)

    def smooth_log_prob(self, value: Tensor) -> Tensor:
        """Return a log density that costs no simulations, for many places (..., d).

        It is :meth:`log_prob` except for beliefs that simulate it.
        """
        return self._by_rows(self._smooth_log_prob, value)

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        return self._log_prob(theta)

    def _by_rows(self, density: Callable[[Tensor], Tensor], value: Tensor) -> Tensor:
        """Return a log density of rows at places of any shape; -inf off the support."""
        theta = torch.as_tensor(value, dtype=torch.float32)
        rows = theta.reshape(-1, theta.shape[-1])
        inside = within_support(self.prior, rows)
        log_prob = torch.where(inside, density(rows).float(), -torch.inf)
        return log_prob.reshape(theta.shape[:-1])

    @cached_property
    def _moments(self) -> tuple[Tensor, Tensor]:
        draws = self.quick_sample(self.num_draws, seed=0).double()
        return draws.mean(0).float(), draws.var(0).float()

    @property
    def mean(self) -> Tensor:
        """Mean over 20,000 draws of the posterior, shape (theta_dim,)."""
        return self._moments[0]

    @property
    def variance(self) -> Tensor:
        """Variance over 20,000 draws of the posterior, shape (theta_dim,)."""
        return self._moments[1]

    def to_pyro(self) -> Any:
        """Return a Pyro distribution, for a sample site of the next model.

        Draws are those of this belief; ``log_prob`` may cost simulations, and has no
        gradient where it does. Needs the extra ``pyro``.
        """
        from sbi_active.inference.beliefs.pyro_belief import PyroBelief

        return PyroBelief(self)

    def __repr__(self) -> str:
        mean, sd = self.mean.tolist(), self.variance.sqrt().tolist()
        names = [f"{name} " for name in self.parameter_names or ()] or [""] * len(mean)
        rows = zip(names, mean, sd, strict=True)
        cells = [f"{name}{with_error(m, s)}" for name, m, s in rows]
        return f"{type(self).__name__}({self.label}: {', '.join(cells)})"

    def _repr_html_(self) -> str:
        draws = self.quick_sample(seed=0)
        return card(
            f"Belief: {self.label}",
            table(Table.of_parameters(names_of(self, draws.shape[1]), draws)),
            self.diagnostics._repr_html_(),
        )


class ChainedBelief(Belief):
    r"""Step 3 of the paper: the amortized posterior at the observed trial.

    .. math::
        b(\theta) = q(\theta | x_o, \xi^*)\, 1[\theta \in \mathrm{supp}\, p] / Z,

    where q was trained under the belief before the trial, so errors of earlier rounds
    stay in it: hence "chained approximation".

    Args:
        estimator: The trained q over packed conditions.
        condition: The observed (x_o, action), shape (1, condition_dim).
        prior: The original prior.
        previous: The belief before the trial.
    """

    label = "chained approximation"

    def __init__(
        self,
        estimator: ConditionalDensityEstimator,
        condition: Tensor,
        prior: Distribution,
        previous: Distribution,
        *,
        minimal_acceptance: float = 1e-3,
    ) -> None:
        super().__init__(prior)
        self._estimator = estimator.eval()
        self._condition = condition
        with torch.no_grad():
            inside = within_support(prior, self._raw(self.num_draws))
        acceptance = float(inside.double().mean())
        self.diagnostics = self.diagnostics.extended(mass_inside_prior=acceptance)
        self._particles: Tensor | None = None
        if acceptance >= minimal_acceptance:
            self._log_normalizer = torch.tensor(acceptance).log()
        else:
            self._resample(previous)
            warn(
                f"SA106 only {acceptance:.2%} of the network's posterior lies within "
                "the prior's support: the observation is unlike those simulated, or "
                "the truth lies outside the prior. The belief is resampled from the "
                "one before and is coarse."
            )

    def _resample(self, previous: Distribution) -> None:
        """Represent the belief by weighted draws of the one before."""
        num = self.num_draws
        draws = previous.sample((num,))
        log_q = self._log_density(draws)
        log_weight = log_q - previous.log_prob(draws)
        log_number = torch.tensor(float(num)).log()
        self._log_normalizer = torch.logsumexp(log_weight, 0) - log_number
        index = torch.multinomial(log_weight.softmax(0), num, replacement=True)
        self._particles = draws[index]

    def _sample(self, num_samples: int) -> Tensor:
        if self._particles is not None:
            return self._particles[torch.randint(len(self._particles), (num_samples,))]
        acceptance = self.diagnostics.mass_inside_prior
        return within_prior(self.prior, self._raw, num_samples, acceptance)

    def _raw(self, num: int) -> Tensor:
        """Return draws of the network, within the support or not."""
        return self._estimator.sample(torch.Size([num]), self._condition)[:, 0]

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self._log_density(theta) - self._log_normalizer

    def _log_density(self, theta: Tensor) -> Tensor:
        with torch.no_grad():
            return self._estimator.log_prob(theta[:, None], self._condition)[:, 0]


def within_prior(
    prior: Distribution,
    draw: Callable[[int], Tensor],
    num_samples: int,
    acceptance: float,
    *,
    most_numbers: int = 10_000_000,
) -> Tensor:
    """Return draws that lie within a prior's support, shape (num_samples, d).

    Args:
        prior: Prior that gives the support.
        draw: Function of a number that returns so many draws, shape (num, d).
        num_samples: Number of draws to return.
        acceptance: Share of draws within the support.
        most_numbers: Numbers of draws at once: networks take some hundred bytes each.
    """
    kept: list[Tensor] = []
    missing, most = num_samples, most_numbers // max(parameter_dim(prior), 10)
    while missing > 0:
        draws = draw(min(int(1.1 * missing / acceptance) + 20, most)).float()
        draws = draws[within_support(prior, draws)]
        kept.append(draws[:missing])
        missing -= len(kept[-1])
    return torch.cat(kept) if kept else torch.zeros(0, parameter_dim(prior))


class UnchangedBelief(Belief):
    """The belief before a trial that the network knows nothing of."""

    label = "unchanged"

    def __init__(self, prior: Distribution, previous: Distribution) -> None:
        super().__init__(prior)
        self.previous = previous

    def _sample(self, num_samples: int) -> Tensor:
        return self.previous.sample(torch.Size([num_samples]))

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self.previous.log_prob(theta)


def information_gained(
    belief: Distribution, previous: Distribution, *, seed: int, num: int = 5_000
) -> float:
    r"""Return the realized information gain of a trial in nats.

    .. math::
        \mathrm{KL}(b \,\|\, p) \approx \frac{1}{n} \sum_i \log b(\theta_i)
        - \log p(\theta_i), \qquad \theta_i \sim b,

    with b the belief after the trial and p the one before.
    """
    with forked_generators(seed):
        theta = belief.sample((num,))
    after, before = (
        getattr(b, "smooth_log_prob", b.log_prob)(theta) for b in (belief, previous)
    )
    return float((after.double() - before.double()).mean())


def named(belief: Distribution, simulator: Any) -> Distribution:
    """Return a belief that knows the names of a simulator's parameters.

    Args:
        belief: Belief that is changed in place, unless it is a distribution of the
            user's.
        simulator: Simulator with or without ``parameter_names``.
    """
    names = getattr(simulator, "parameter_names", None)
    if not isinstance(belief, Belief) or names is None:
        return belief
    if len(names) == belief.event_shape[0]:
        belief.parameter_names = (*names,)
    return belief


def names_of(belief: Distribution, num: int) -> list[str]:
    """Return the names of a belief's parameters, theta_1, ... where it has none.

    Args:
        belief: The belief, or a prior.
        num: Number of its parameters.

    Example:
        >>> names_of(torch.distributions.Normal(0.0, 1.0), 2)
        ['theta_1', 'theta_2']
    """
    names = getattr(belief, "parameter_names", None)
    return [f"theta_{i + 1}" for i in range(num)] if names is None else [*names]


class ParticleDraws(Distribution):
    """Parameters out of a finite set (p, theta_dim), each as likely.

    It has no density, only probabilities, so it is a belief to design with and none to
    train under.
    """

    arg_constraints = {}  # pyright: ignore

    def __init__(self, particles: Tensor) -> None:
        super().__init__(
            torch.Size(), torch.Size([particles.shape[1]]), validate_args=False
        )
        self.particles = particles

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        """Return draws, shape (*sample_shape, theta_dim)."""
        return self.particles[torch.randint(len(self.particles), tuple(sample_shape))]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log probability of each row, shape (...); -inf off the set."""
        among = (value[..., None, :] == self.particles).all(-1).any(-1)
        return torch.where(among, 1 / len(self.particles), 0.0).log()


def compare(
    refined: Belief,
    chained: ChainedBelief,
    *,
    tolerance: float = 0.5,
    floor: float = -60.0,
    num: int = 2_000,
) -> None:
    r"""Add figures on the network's belief to the refined belief's diagnostics.

    A network can pass a calibration test and be nats blunter than the data allow, since
    calibration sees no sharpness. Against the refined belief r, with c the chained one:

    .. math::
        \mathrm{loss} = E_r[\log r(\theta) - \log c(\theta)], \qquad
        \mathrm{bluntness} = H(c) - H(r).

    A loss with a positive bluntness is under-confidence; a loss without it is
    overconfidence or a wrong place. The loss is bounded by 60 nats, which no density
    in float32 is below another; beyond half a nat it is a warning. Of 2,000 draws the
    means are known to .02 nats a parameter.
    """
    with forked_generators(0, "compare"):
        draws = refined.sample((num,))
        chained_draws = chained.sample((num,))
    refined_score = float(refined.log_prob(draws).double().mean())
    chained_log_prob = chained.log_prob(draws).double()
    score = float(chained_log_prob.clamp_min(refined_score + floor).mean())
    entropy = -float(chained.log_prob(chained_draws).double().mean())
    loss, bluntness = refined_score - score, entropy + refined_score
    kind = f"overconfident or misplaced, {loss:.1f} nats behind the refined belief"
    if bluntness > 0.5 * loss:
        kind = f"under-confident, {bluntness:.1f} nats blunter than the refined belief"
    text = f"SA122 the amortized network is {kind}"
    refined.diagnostics = refined.diagnostics.extended(
        refined_log_score=refined_score,
        chained_log_score=score,
        chained_loss=loss,
        chained_bluntness=bluntness,
        network_warnings=(text,) if loss > tolerance else (),
    )
