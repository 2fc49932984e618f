"""Choose the next action by expected information gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.design import Design, action_name
from sbi_active.eligibility import discrete, excluded_note, reaches, warn_missing
from sbi_active.information_gain import (
    CandidateSimulations,
    InformationGainEstimator,
    ModelIndexGain,
    ParameterGain,
    RivalPredictive,
    RivalSampler,
)
from sbi_active.information_gain.automatic import (
    choose_estimator,
    disagreements,
    find_estimator,
)
from sbi_active.information_gain.candidates import CandidateSampler
from sbi_active.information_gain.race import Race, paired_errors, standard_error
from sbi_active.random_designer import RandomDesigner
from sbi_active.threads import single_thread

__all__ = ["Design", "InformationGainDesigner", "RandomDesigner"]


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
        num_workers: Of the simulations, see
            :func:`~sbi_active.simulation.simulate`.
        time_limit: Seconds a simulated row may take; None waits for ever. With it, or
            with more than one worker, a simulator that ends its process costs a row.
        num_retries: How often a row that a fault lost is tried again.

    Raises:
        ValueError: If ``num_samples`` is below 8 or the estimator's name is unknown.
        TypeError: If the action space is not discrete.

    Example:
        >>> from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
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
        num_workers: int = 1,
        time_limit: float | None = None,
        num_retries: int = 0,
    ) -> None:
        if num_samples < 8:
            raise ValueError(
                f"expected num_samples >= 8, half to choose and half to report; got "
                f"{num_samples}; do use about 1000"
            )
        self.actions = discrete(actions)
        self.num_samples = num_samples
        self.estimator = estimator
        self.eliminate = eliminate
        self.engine: dict[str, Any] = {
            "num_workers": num_workers,
            "time_limit": time_limit,
            "num_retries": num_retries,
        }
        find_estimator(estimator)  # an unknown name is an error here

    def select(
        self,
        model: Any,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        target: str | Sequence[str] = "theta",
        min_probability_valid: float = 0.0,
        budget: int | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return the action that tells most about the target.

        Args:
            model: What the estimator needs, for :class:`PosteriorGain` anything with
                ``log_posterior(theta, x, action)``; None where it needs nothing. For
                the target "model" the rivals, a sequence of
                :class:`~sbi_active.information_gain.RivalPredictive`.
            simulator: ``simulator(theta, action)``; not used for the target "model".
            belief: Distribution of the parameters; None is ``model.belief``.
            target: "theta", all parameters; one or several names of the simulator's
                parameters, the others being nuisances
                (:class:`~sbi_active.information_gain.ParameterGain`); or "model", the
                index of the rivals
                (:class:`~sbi_active.information_gain.ModelIndexGain`). The estimates of
                the latter two are lower bounds.
            min_probability_valid: Candidates that give a measurement less often, by
                the share of the first simulations, are not chosen; 0 excludes none.
            budget: Simulations in all; None is ``num_samples`` a candidate.
            seed: Of the simulations; None draws one from torch's global generator.

        Returns:
            The design.

        Raises:
            ValueError: If there is no belief, the budget is below 8 a candidate, the
                simulator is deterministic, the estimator needs a model, the target is
                unknown, or no candidate is valid often enough.
        """
        num_actions = len(self.actions)
        budget = self.num_samples * num_actions if budget is None else budget
        if budget < 8 * num_actions:
            raise ValueError(
                f"expected a budget >= {8 * num_actions}, 8 a candidate; got {budget}; "
                "do allow more simulations or fewer candidates"
            )
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        sampler, estimator, belief = self._prepare(
            model, simulator, belief, target, seed
        )
        replicates = estimator is None or estimator.needs_noise
        size = max(8, self.num_samples // (2 if self.eliminate else 1))
        size = min(size, budget // num_actions) // 4 * 4
        first = sampler.draw(size, torch.arange(num_actions), replicates=replicates)
        notes: list[str] = []
        if estimator is None:
            estimator, notes = choose_estimator(model, first)
        else:
            notes = estimator.problems(first)
        notes += estimator.remarks(first)
        replicates = first.replicate is not None
        halves = _halves(first)
        num_valid, num_counted = first.num_valid()
        eligible = reaches(num_valid / num_counted, min_probability_valid)
        notes += excluded_note(eligible, min_probability_valid)

        gains = [[torch.empty(0)] * num_actions for _ in range(2)]

        def estimate(index: Tensor, halves: list[CandidateSimulations]) -> None:
            for half, gain in zip(halves, gains, strict=True):
                with single_thread():
                    contributions = estimator(model, half, belief)
                for a, row in zip(index.tolist(), contributions, strict=True):
                    gain[a] = row

        active, excluded = (torch.nonzero(e)[:, 0] for e in (eligible, ~eligible))
        if len(excluded):  # estimated once, never chosen
            estimate(excluded, [half.candidates(excluded) for half in halves])
            halves = [half.candidates(active) for half in halves]
        while True:
            estimate(active, halves)
            race = Race.run([gains[0][a] for a in active], seed)
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
            drawn = sampler.draw(more, active, replicates=replicates)
            for count, new in zip(
                (num_valid, num_counted), drawn.num_valid(), strict=True
            ):
                count[active] += new
            halves = [
                half.candidates(keep).join(new)
                for half, new in zip(halves, _halves(drawn), strict=True)
            ]

        warn_missing(sampler.num_missing, sampler.num_drawn)
        contributions = torch.stack([gains[0][a] for a in active])
        with single_thread():
            notes += disagreements(estimator, model, halves[0], belief, contributions)
        chosen = int(active[race.leader])
        report = gains[1]
        both = [torch.cat(rows) for rows in zip(*gains, strict=True)]
        probability_best = torch.zeros(num_actions, dtype=torch.float64)
        probability_best[eligible] = Race.run(
            [row for row, e in zip(both, eligible.tolist(), strict=True) if e], seed
        ).probability_best
        samples = [(2 if replicates else 1) * len(row) for row in both]
        return Design(
            action=self.actions.values[chosen],
            candidates=self.actions.values,
            expected_information_gain=torch.stack([row.nanmean() for row in report]),
            standard_error=torch.stack([standard_error(row) for row in report]),
            difference_standard_error=paired_errors(report, chosen),
            probability_best=probability_best,
            probability_valid=num_valid / num_counted.double(),
            bound=estimator.bound,
            index=chosen,
            num_simulations=sampler.num_drawn,
            name=action_name(self.actions),
            estimator=type(estimator).__name__,
            num_samples=torch.tensor(samples),
            stopped=stop,
            num_missing=sampler.num_missing,
            notes=tuple(notes),
        )

    def _prepare(
        self,
        model: Any,
        simulator: Callable[..., Any] | None,
        belief: Distribution | None,
        target: str | Sequence[str],
        seed: int,
    ) -> tuple[CandidateSampler | RivalSampler, InformationGainEstimator | None, Any]:
        """Return what draws outcomes, the estimator (None: by checks), and belief."""
        if target != "theta" and self.estimator != "auto":
            raise ValueError(
                f"expected estimator='auto' for target={target!r}, whose estimator is "
                f"its own; got {self.estimator!r}; do leave out estimator="
            )
        if target == "model":
            if not isinstance(model, Sequence):
                raise ValueError(
                    "expected a sequence of rivals for target='model'; got "
                    f"{type(model).__name__}; do pass objects with probability and "
                    "predict(action, num_samples, seed)"
                )
            rivals: Sequence[RivalPredictive] = model
            sampler = RivalSampler(rivals, self.actions.values, seed)
            return sampler, ModelIndexGain(sampler.probability), None
        if simulator is None:
            raise ValueError(
                "expected a simulator; got None; do pass the one that the belief's "
                "parameters belong to"
            )
        belief = getattr(model, "belief", None) if belief is None else belief
        if belief is None:
            raise ValueError(
                "expected belief=, the distribution of the parameters; got none, and "
                "the model has none; do pass the belief of this round"
            )
        if target == "theta":
            estimator = find_estimator(self.estimator)
        else:
            estimator = ParameterGain(_parameters(target, simulator))
        if estimator is not None and estimator.needs_model and model is None:
            raise ValueError(
                f"expected a model for {type(estimator).__name__}; got None; do pass "
                "the trained posterior, or estimator='auto'"
            )
        sampler = CandidateSampler(
            simulator, belief, self.actions.values, seed, self.engine
        )
        return sampler, estimator, belief


def _parameters(target: str | Sequence[str], simulator: Any) -> list[int]:
    """Return the places of parameters by name."""
    names = getattr(simulator, "parameter_names", None)
    if not names:
        raise ValueError(
            f"expected a simulator with parameter_names for target={target!r}; got "
            "none; do build SimulatorModel(fn, parameter_names=[...])"
        )
    wanted = [target] if isinstance(target, str) else list(target)
    unknown = [name for name in wanted if name not in names]
    if unknown or not wanted:
        raise ValueError(
            f"expected target 'theta', 'model' or names among {list(names)}; got "
            f"{target!r}; do choose one or more of these"
        )
    return [list(names).index(name) for name in wanted]


def _halves(simulations: CandidateSimulations) -> list[CandidateSimulations]:
    half = len(simulations.theta) // 2
    return [
        simulations.samples(slice(half)),
        simulations.samples(slice(half, 2 * half)),
    ]
