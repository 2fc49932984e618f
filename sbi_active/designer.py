"""Choose the next action by expected information gain, or at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.information_gain import (
    CandidateSimulations,
    InformationGainEstimator,
    PosteriorGain,
)
from sbi_active.information_gain.base import Bound
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Design", "InformationGainDesigner", "RandomDesigner"]


#: Draws behind ``probability_best``; its standard error is at most .016.
DRAWS = 1_000


@dataclass(frozen=True)
class Design:
    """The chosen action and the estimates behind the choice.

    Attributes:
        action: The chosen action, shape (action_dim,).
        candidates: All candidates, shape (a, action_dim).
        expected_information_gain: Estimates on simulations that had no part in the
            choice, nats, shape (a,); NaN for a random choice.
        standard_error: Of each estimate, shape (a,).
        difference_standard_error: Of each estimate's difference to the chosen
            candidate's, on common random numbers, shape (a,); zero at the chosen one.
        probability_best: Probability that a candidate has the largest expectation of
            the estimate, given the simulations, shape (a,).
        probability_valid: Share of simulations with a measurement, shape (a,).
        bound: Side of the information that the estimates lie on.
        index: Which candidate was chosen.
        num_simulations: Simulations spent.
        name: Name of the action, with its unit.
    """

    action: Tensor
    candidates: Tensor
    expected_information_gain: Tensor
    standard_error: Tensor
    difference_standard_error: Tensor
    probability_best: Tensor
    probability_valid: Tensor
    bound: Bound
    index: int
    num_simulations: int
    name: str = "action"

    def __repr__(self) -> str:
        action = ", ".join(f"{v:g}" for v in self.action.tolist())
        if self.expected_information_gain.isnan().all():
            return f"Design(action [{action}], at random)"
        gain = float(self.expected_information_gain[self.index])
        error = float(self.standard_error[self.index])
        return f"Design(action [{action}], EIG {gain:.2f} +- {error:.2f} nats)"

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the expected information gain of the candidates with two errors.

        Args:
            ax: Where to draw; None makes a figure.

        Returns:
            The axes.
        """
        import matplotlib.pyplot as plt

        ax = plt.subplots()[1] if ax is None else ax
        scalar = self.candidates.shape[1] == 1
        place = self.candidates[:, 0] if scalar else torch.arange(len(self.candidates))
        gain, error = self.expected_information_gain, self.standard_error
        ax.errorbar(
            place.numpy(), gain.numpy(), 2 * error.numpy(), fmt="o-", ms=4, capsize=2
        )
        ax.axvline(float(place[self.index]), ls=":", color="k", label="chosen")
        ax.set_xlabel(self.name if scalar else "candidate")
        note = {"lower": " (lower bound)", "upper": " (upper bound)", "none": ""}
        ax.set_ylabel(f"EIG{note[self.bound]} [nats]")
        ax.legend()
        return ax


class InformationGainDesigner:
    r"""Choose :math:`\xi^* = \arg\max_\xi U(\xi)` among discrete actions (Eq. 13).

    Every candidate is simulated at the same parameters, so that estimates are compared
    on common random numbers. One half of the simulations chooses; the other half
    reports, since the largest of many noisy estimates is too large.

    Args:
        actions: The candidates.
        num_samples: Simulations a candidate, half of them to choose, half to report.
        estimator: Of the information gain.

    Raises:
        ValueError: If ``num_samples`` is below 4.
        TypeError: If the action space is not discrete.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> class Exact:  # x = action * theta + noise, prior N(0, 1)
        ...     def log_posterior(self, theta, x, action):
        ...         var = 1 / (1 + action**2)
        ...         return torch.distributions.Normal(
        ...             var * action * x, var.sqrt()).log_prob(theta)[:, 0]
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
        >>> designer = InformationGainDesigner(
        ...     DiscreteActions([0.1, 1.0, 2.0]), num_samples=400)
        >>> design = designer.select(
        ...     Exact(), lambda t, a: a * t + torch.randn_like(t), belief=prior, seed=0)
        >>> design.action
        tensor([2.])
    """

    def __init__(
        self,
        actions: ActionSpace,
        *,
        num_samples: int = 1_000,
        estimator: InformationGainEstimator | None = None,
    ) -> None:
        if num_samples < 4:
            raise ValueError(
                f"expected num_samples >= 4, half to choose and half to report; got "
                f"{num_samples}; do use about 1000"
            )
        self.actions = _discrete(actions)
        self.num_samples = num_samples
        self.estimator = PosteriorGain() if estimator is None else estimator

    def select(
        self,
        model: Any,
        simulator: Callable[..., Any],
        *,
        belief: Distribution | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return the action that tells most about the parameters.

        Args:
            model: What the estimator needs, for :class:`PosteriorGain` anything with
                ``log_posterior(theta, x, action)``.
            simulator: ``simulator(theta, action)``.
            belief: Distribution of the parameters; None is ``model.belief``.
            seed: Of the simulations; None draws one from torch's global generator.

        Returns:
            The design.

        Raises:
            ValueError: If there is no belief, or the simulator is deterministic.
        """
        belief = getattr(model, "belief", None) if belief is None else belief
        if belief is None:
            raise ValueError(
                "expected belief=, the distribution of the parameters; got none, and "
                "the model has none; do pass the belief of this round"
            )
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        simulations = self._simulate(simulator, belief, seed)
        gain = self.estimator(model, simulations, belief)
        half = self.num_samples // 2
        chosen = int(gain[:, :half].mean(1).argmax())
        report = gain[:, half:]
        return Design(
            action=self.actions.values[chosen],
            candidates=self.actions.values,
            expected_information_gain=report.mean(1),
            standard_error=_standard_error(report),
            difference_standard_error=_standard_error(report - report[chosen]),
            probability_best=_probability_best(gain, seed),
            probability_valid=simulations.x.flatten(2)
            .isfinite()
            .any(-1)
            .double()
            .mean(1),
            bound=self.estimator.bound,
            index=chosen,
            num_simulations=gain.numel(),
            name=_name(self.actions),
        )

    def _simulate(
        self, simulator: Callable[..., Any], belief: Distribution, seed: int
    ) -> CandidateSimulations:
        with forked_generators(seed, "theta"):
            theta = belief.sample((self.num_samples,))
        candidates = self.actions.values
        rows = simulate(
            simulator,
            theta.repeat(len(candidates), 1),
            candidates.repeat_interleave(len(theta), 0),
            seed=derive_seed(seed, "x"),
            check_noise=True,
        )
        x = rows.x.reshape(len(candidates), len(theta), *rows.x.shape[1:])
        return CandidateSimulations(theta, candidates, x)


class RandomDesigner:
    """Choose an action uniformly at random, the design of NSBI and NLHI.

    Args:
        actions: The action space.
    """

    def __init__(self, actions: ActionSpace) -> None:
        self.actions = _discrete(actions)

    def select(
        self,
        model: Any = None,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return a random action; model, simulator and belief are not used."""
        with forked_generators(seed):
            chosen = int(torch.randint(len(self.actions), ()))
        unknown = torch.full((len(self.actions),), torch.nan, dtype=torch.float64)
        return Design(
            action=self.actions.values[chosen],
            candidates=self.actions.values,
            expected_information_gain=unknown,
            standard_error=unknown,
            difference_standard_error=unknown,
            probability_best=unknown,
            probability_valid=unknown,
            bound="none",
            index=chosen,
            num_simulations=0,
            name=_name(self.actions),
        )


def _discrete(actions: ActionSpace) -> DiscreteActions:
    if not isinstance(actions, DiscreteActions):
        raise TypeError(
            f"expected DiscreteActions; got {type(actions).__name__}; do list the "
            "candidates, DiscreteActions(values)"
        )
    return actions


def _name(actions: DiscreteActions) -> str:
    if actions.action_dim > 1:
        return "action"
    unit = actions.units[0]
    return actions.names[0] + (f" [{unit}]" if unit else "")


def _standard_error(contributions: Tensor) -> Tensor:
    return contributions.std(1) / contributions.shape[1] ** 0.5


def _probability_best(contributions: Tensor, seed: int) -> Tensor:
    r"""Return how often each candidate has the largest mean under the central limit.

    The means of the candidates are jointly Gaussian with the covariance of the paired
    contributions over n. It is applied through the contributions themselves,
    :math:`\sum_i w_i (g_i - \bar g) / n` with standard normal weights, which needs no
    factor of an almost singular matrix.
    """
    num = contributions.shape[1]
    generator = torch.Generator().manual_seed(derive_seed(seed, "best"))
    weights = torch.randn(num, DRAWS, generator=generator, dtype=contributions.dtype)
    mean = contributions.mean(1, keepdim=True)
    draws = mean + (contributions - mean) @ weights / num
    best = torch.bincount(draws.argmax(0), minlength=len(contributions))
    return best.double() / DRAWS
