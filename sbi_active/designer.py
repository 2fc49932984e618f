"""Choose the next action by expected information gain, or at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.information_gain import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.automatic import (
    choose_estimator,
    disagreements,
    find_estimator,
)
from sbi_active.information_gain.base import Bound
from sbi_active.information_gain.candidates import CandidateSampler
from sbi_active.information_gain.race import Race, paired_errors, standard_error
from sbi_active.seeding import forked_generators
from sbi_active.threads import single_thread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Design", "InformationGainDesigner", "RandomDesigner"]


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
        estimator: Class that estimated.
        num_samples: Simulations of each candidate, shape (a,). Candidates that were
            eliminated early have fewer.
        stopped: Why no further simulations were run: "leader separated", "difference
            negligible" or "budget spent".
        notes: What to know: estimators that failed a check or disagree.
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
    estimator: str = "none"
    num_samples: Tensor = field(default_factory=lambda: torch.empty(0).long())
    stopped: str = "at random"
    notes: tuple[str, ...] = ()

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
    r"""Choose :math:`\xi^* = \arg\max_\xi I(\theta; x | \xi)` among discrete actions.

    All candidates are simulated at the same parameters, so that estimates are compared
    on common random numbers. Half of the simulations choose; the others report, since
    the largest of many noisy estimates is too large. Every candidate first gets half
    of ``num_samples``. Those within some standard errors of the leader then get twice
    as many again and again, until the leader is the best with a probability of .95, or
    is expected to lose less than .05 nat, or the budget is spent (successive
    elimination). The report has no part in this.

    Args:
        actions: The candidates.
        num_samples: Simulations a candidate on average; an action that stays among the
            leading ones gets at most four times as many.
        estimator: Of the information gain: an estimator; "entropy", "nested" or
            "posterior" (see :mod:`sbi_active.information_gain`); or "auto". That takes
            declared noise first (entropies by nearest neighbors where x is one number,
            nested Monte Carlo where it is more), then the same with noise from
            replicates that pass a test of normality, else the network's bound.
        eliminate: Start with half of the samples and spend the rest on the candidates
            still in reach of the leader; without it every candidate gets all of them.

    Raises:
        ValueError: If ``num_samples`` is below 8 or the estimator's name is unknown.
        TypeError: If the action space is not discrete.

    Example:
        >>> from sbi_active import GaussianNoise, SimulatorModel
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
        >>> designer = InformationGainDesigner(
        ...     DiscreteActions([0.1, 1.0, 4.0]), num_samples=400)
        >>> simulator = SimulatorModel(lambda t, a: a * t, noise=GaussianNoise(1.0))
        >>> design = designer.select(None, simulator, belief=prior, seed=0)
        >>> design.action, design.estimator
        (tensor([4.]), 'EntropyGain')

    References:
        Even-Dar, Mannor & Mansour, JMLR 2006 (successive elimination).
    """

    def __init__(
        self,
        actions: ActionSpace,
        *,
        num_samples: int = 1_500,
        estimator: str | InformationGainEstimator = "auto",
        eliminate: bool = True,
    ) -> None:
        if num_samples < 8:
            raise ValueError(
                f"expected num_samples >= 8, half to choose and half to report; got "
                f"{num_samples}; do use about 1000"
            )
        self.actions = _discrete(actions)
        self.num_samples = num_samples
        self.estimator = estimator
        self.eliminate = eliminate
        find_estimator(estimator)  # an unknown name is an error here

    def select(
        self,
        model: Any,
        simulator: Callable[..., Any],
        *,
        belief: Distribution | None = None,
        budget: int | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return the action that tells most about the parameters.

        Args:
            model: What the estimator needs, for :class:`PosteriorGain` anything with
                ``log_posterior(theta, x, action)``; None where it needs nothing.
            simulator: ``simulator(theta, action)``.
            belief: Distribution of the parameters; None is ``model.belief``.
            budget: Simulations in all; None is ``num_samples`` a candidate.
            seed: Of the simulations; None draws one from torch's global generator.

        Returns:
            The design.

        Raises:
            ValueError: If there is no belief, the budget is below 8 a candidate, the
                simulator is deterministic, or the estimator needs a model.
        """
        belief = getattr(model, "belief", None) if belief is None else belief
        if belief is None:
            raise ValueError(
                "expected belief=, the distribution of the parameters; got none, and "
                "the model has none; do pass the belief of this round"
            )
        num_actions = len(self.actions)
        budget = self.num_samples * num_actions if budget is None else budget
        if budget < 8 * num_actions:
            raise ValueError(
                f"expected a budget >= {8 * num_actions}, 8 a candidate; got {budget}; "
                "do allow more simulations or fewer candidates"
            )
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        sampler = CandidateSampler(simulator, belief, self.actions.values, seed)
        estimator = find_estimator(self.estimator)
        replicates = estimator is None or estimator.needs_noise
        active = torch.arange(num_actions)
        size = max(8, self.num_samples // (2 if self.eliminate else 1))
        size = min(size, budget // num_actions) // 4 * 4
        first = sampler.draw(size, active, replicates=replicates)
        notes: list[str] = []
        if estimator is None:
            estimator, notes = choose_estimator(model, first)
        elif estimator.needs_model and model is None:
            raise ValueError(
                f"expected a model for {type(estimator).__name__}; got None; do pass "
                "the trained posterior, or estimator='auto'"
            )
        else:
            notes = estimator.problems(first)
        replicates &= estimator.needs_noise
        halves = _halves(first)
        if not replicates:
            halves = [half.unpaired() for half in halves]

        gains = [[torch.empty(0)] * num_actions for _ in range(2)]
        while True:
            for half, gain in zip(halves, gains, strict=True):
                with single_thread():
                    contributions = estimator(model, half, belief)
                for index, row in zip(active.tolist(), contributions, strict=True):
                    gain[index] = row
            race = Race.run([gains[0][index] for index in active], seed)
            keep = race.in_reach
            spent = 2 * len(halves[0].theta) * (2 if replicates else 1)
            more = min(
                spent,
                4 * self.num_samples - spent,
                (budget - sampler.num_drawn) // int(keep.sum()) // 4 * 4,
            )
            stop = race.reason()
            if stop is None and more < 8:
                stop = "budget spent"
            if stop is not None:
                break
            active = active[keep]
            wave = _halves(sampler.draw(more, active, replicates=replicates))
            halves = [
                half.candidates(keep).join(new)
                for half, new in zip(halves, wave, strict=True)
            ]

        contributions = torch.stack([gains[0][index] for index in active])
        with single_thread():
            notes += disagreements(estimator, model, halves[0], belief, contributions)
        chosen = int(active[race.leader])
        report = gains[1]
        gain = torch.stack([row.mean() for row in report])
        return Design(
            action=self.actions.values[chosen],
            candidates=self.actions.values,
            expected_information_gain=gain,
            standard_error=torch.stack([standard_error(row) for row in report]),
            difference_standard_error=paired_errors(report, chosen),
            probability_best=Race.run(
                [torch.cat(rows) for rows in zip(*gains, strict=True)], seed
            ).probability_best,
            probability_valid=first.x.flatten(2).isfinite().any(-1).double().mean(1),
            bound=estimator.bound,
            index=chosen,
            num_simulations=sampler.num_drawn,
            name=_name(self.actions),
            estimator=type(estimator).__name__,
            num_samples=torch.tensor(
                [
                    (2 if replicates else 1) * (len(c) + len(r))
                    for c, r in zip(*gains, strict=True)
                ]
            ),
            stopped=stop,
            notes=tuple(notes),
        )


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
            num_samples=torch.zeros(len(self.actions)).long(),
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


def _halves(simulations: CandidateSimulations) -> list[CandidateSimulations]:
    half = len(simulations.theta) // 2
    return [
        simulations.samples(slice(half)),
        simulations.samples(slice(half, 2 * half)),
    ]
