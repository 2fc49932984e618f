"""Sizes and estimators of a campaign, and when it has learned enough."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import cloudpickle
import torch
from attrs import field, frozen
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.design.estimators.automatic import find_estimator
from sbi_active.expected import (
    at_least,
    of_class,
    one_of,
    positive,
    require,
    suggests,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.renamed import grouped, takes_loose
from sbi_active.seeding import draws_of
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@suggests
@frozen(kw_only=True, slots=False)
class CampaignDetails:
    """Options that few campaigns change; the papers' experiments do.

    Attributes:
        posterior: Sampling method for beliefs of "alhi", "nlhi" and "seqbed", see
            :class:`.ALHI`.
        eliminate: Whether candidates far behind the leader get no further samples.
        num_scored: Simulations of each executed action, from the belief before the
            trial, that its outcome is compared with.
        look_ahead: Trials that are planned together where the cost depends on the trial
            before, 1 or 2. With 2 the next action is the first of the pair whose joint
            information by total cost is largest.
    """

    posterior: str = "importance"
    eliminate: bool = field(default=True, validator=of_class(bool))
    num_scored: int = field(
        default=2_000,
        validator=at_least(
            100, "use about 2000: no tail probability is below 1 / (num_scored + 1)"
        ),
    )
    look_ahead: int = field(default=2, validator=one_of(1, 2))


#: Of rules to stop by: none of them has to be given.
_limit = positive("leave a rule at None that is not wanted")


def _numbers(limit: float | Iterable[float] | None) -> float | Sequence[float] | None:
    """Return a limit as it is, or several as a tuple of numbers."""
    return (*map(float, limit),) if isinstance(limit, Iterable) else limit


@suggests
@frozen(kw_only=True, slots=False)
class StopRules:
    """Rules by which :meth:`.Campaign.run` ends before its last round.

    Any one ends it, but ``min_information_gain`` and ``max_sd`` only while the
    campaign's health is "ok": with a simulator that lacks something, a belief becomes
    narrow at a wrong place, and both would stop.

    Attributes:
        min_information_gain: Smallest expected information gain of the next trial,
            nats.
        max_sd: Largest standard deviation of any parameter under the belief: one
            number, or one a parameter, in the parameters' units.
        budget: Total cost of all trials, in the unit of ``Campaign(cost=)``; without a
            cost, their number. A campaign ends once what is left affords no action.

    Example:
        >>> StopRules(min_information_gain=0.1, max_sd=[0.05, 0.2])
        StopRules(min_information_gain=0.1, max_sd=(0.05, 0.2), budget=None)
    """

    min_information_gain: float | None = field(default=None, validator=_limit)
    max_sd: float | Sequence[float] | None = field(
        default=None, converter=_numbers, validator=_limit
    )
    budget: float | None = field(default=None, validator=_limit)

    def reason(
        self,
        belief: Distribution,
        design: Design | None,
        *,
        seed: int,
        num_draws: int = 2_000,
    ) -> str | None:
        """Return why to stop, or None.

        Args:
            belief: Belief after all trials.
            design: Design of the next trial, if there is one.
            seed: Seed of the belief's draws.
            num_draws: Draws of the belief; 2,000 give a standard deviation to 1.6 %.

        Raises:
            ValueError: If ``max_sd`` has neither one number nor one a parameter.
        """
        if design is not None and self.min_information_gain is not None:
            gain = float(design.expected_information_gain[design.index])
            if gain < self.min_information_gain:
                return (
                    f"the next trial is expected to tell {gain:.3g} nats, less than "
                    f"{self.min_information_gain:g}"
                )
        if self.max_sd is None:
            return None
        sd = draws_of(belief, num_draws, seed, "stop").double().std(0)
        limits = torch.tensor(self.max_sd, dtype=torch.float64).reshape(-1)
        if len(limits) not in (1, len(sd)):
            raise ValueError(
                f"expected one max_sd or one for each of {len(sd)} parameters; got "
                f"{len(limits)}; give max_sd in the order of the parameters, those "
                "of adopted effects last"
            )
        if not bool((sd < limits).all()):
            return None
        widths = ", ".join(f"{v:.3g}" for v in sd.tolist())
        return f"the parameters' standard deviations are {widths}, below max_sd"


def _is_estimator(options: Any, attribute: Any, value: Any) -> None:
    find_estimator(value)


def _are_of_refinement_too(options: Any, attribute: Any, workers: Workers) -> None:
    require(
        options.refinement.workers in (IN_PROCESS, workers),
        f"the refinement's simulations to run as all others of a campaign, {workers}",
        f"{options.refinement.workers} for them",
        "pass workers to CampaignOptions alone",
    )


#: Settings whose fields were options of a campaign in the last version.
GROUPS = {"workers": Workers, "details": CampaignDetails}


@takes_loose(**GROUPS)
@frozen(kw_only=True, slots=False)
class CampaignOptions:
    """Sizes and estimators of a campaign.

    ``attrs.evolve(options, num_samples=500)`` returns a copy with another value, of
    these and all other options.

    Attributes:
        num_simulations: Number of training rows in each round.
        num_samples: Number of simulations of each candidate action for the expected
            information gain, half to choose and half to report.
        density_estimator: Density estimator that is trained, as in :class:`.ASBI` and
            :class:`.ALHI`; for "seqbed" a classifier as in :class:`.SeqBED`, or
            :class:`.LFIRE`.
        estimator: Estimator of the expected information gain, as in
            :class:`.InformationGainDesigner`; "posterior" is the paper's.
        refine: Whether a belief is refined with the simulator after each trial; without
            it, beliefs are chained as in the paper.
        network: Time when a round's network is trained: "each round", so that the
            amortized posterior is available and refined beliefs are compared with it;
            or "on demand", when it is needed: :attr:`.Campaign.posterior`, an
            estimator of the information gain that rests on it, a belief that is not
            refined. With declared noise nothing in a round does, which then takes a
            fraction of the time (``benchmarks/cost/network.json``). Beliefs are refined
            without the network whoever asked for it, so that asking changes nothing.
        refinement: Settings of the refinement, whose simulations run as all others.
        check_every: Interval of trials that check the simulator at an action far from
            all others, instead of the most informative one: any simulator fits as many
            settings as it has parameters. None never checks. A campaign with effects
            designs for the model by itself.
        stop: Rules by which :meth:`.Campaign.run` ends before its last round.
        max_simulations: Simulations of the whole campaign, which never simulates more:
            belief, designs and scores then share one pool of rows
            (:mod:`sbi_active.inference.emulation`), and no network is trained. When
            they are used up, :meth:`.Campaign.run` ends, :meth:`.Campaign.ask` says so
            and the last belief stands. ``Campaign.state.meter`` has what was spent.
        planned_trials: Trials that ``max_simulations`` is to last for; each further one
            gets half of what is left.
        workers: Workers that run all simulations, or the number of calls at a time.
        details: Further options that few campaigns change.
    """

    num_simulations: int = field(
        default=5_000, validator=at_least(100, "use about 5000 a round")
    )
    num_samples: int = field(
        default=1_500, validator=at_least(8, "use about 1500 an action")
    )
    density_estimator: Any = None
    estimator: Any = field(default="auto", validator=_is_estimator)
    refine: bool = field(default=True, validator=of_class(bool))
    network: Literal["each round", "on demand"] = field(
        default="each round", validator=one_of("each round", "on demand")
    )
    refinement: RefinementOptions = field(
        default=RefinementOptions(), validator=of_class(RefinementOptions)
    )
    check_every: int | None = field(
        default=None,
        validator=at_least(1, "use 2 or 3 where the simulator may lack something"),
    )
    stop: StopRules = field(default=StopRules(), validator=of_class(StopRules))
    max_simulations: int | None = field(
        default=None, validator=at_least(100, "use some hundred a trial")
    )
    planned_trials: int = field(
        default=6, validator=at_least(1, "pass the number of trials that you can run")
    )
    workers: Workers = field(
        default=IN_PROCESS, converter=Workers.of, validator=_are_of_refinement_too
    )
    details: CampaignDetails = field(
        default=CampaignDetails(), validator=of_class(CampaignDetails)
    )

    def __getstate__(self) -> dict[str, Any]:
        # Builders of sbi's are local functions, which pickle refuses.
        estimator = cloudpickle.dumps(self.density_estimator)
        return {**vars(self), "density_estimator": estimator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        estimator = cloudpickle.loads(state["density_estimator"])
        # Those of the last version had the fields of both settings themselves.
        vars(self).update(grouped(state, GROUPS), density_estimator=estimator)

    @classmethod
    def of(cls, options: Any) -> CampaignOptions:
        """Return options as they are, or from a dict of their fields; None is default.

        Raises:
            TypeError: If they are neither, or a field has another name.
        """
        if options is None or isinstance(options, cls):
            return options or cls()
        if not isinstance(options, Mapping):
            raise TypeError(
                f"expected options of a campaign; got {options!r}; pass "
                "CampaignOptions(...), or a dict of its fields"
            )
        return cls(**options)

    @classmethod
    def faithful(cls) -> CampaignOptions:
        """Return the setting of the paper's numerical experiment.

        Section 5.2 of Kim & Matsubara (2025): 2000 steps of batch 50, M = 1000 samples
        to choose an action, the network's value as the next belief. The number of rows
        a round is not given there; 10,000 reproduce the paper's level.
        """
        return cls(
            num_simulations=10_000,
            num_samples=2_000,
            density_estimator=MixtureDensity.faithful(),
            estimator="posterior",
            refine=False,
            details=CampaignDetails(eliminate=False),
        )
