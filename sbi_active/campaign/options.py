"""Sizes and estimators of a campaign, and when it has learned enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cloudpickle
import numpy as np
import torch
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.design.estimators.automatic import find_estimator
from sbi_active.expected import (
    require,
    require_kinds,
    require_least,
    require_one_of,
    suggests,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.renamed import grouped, takes_loose
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@suggests
@dataclass(frozen=True, kw_only=True)
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
    eliminate: bool = True
    num_scored: int = 2_000
    look_ahead: int = 2

    def __post_init__(self) -> None:
        advice = "use about 2000: no tail probability is below 1 / (num_scored + 1)"
        require_least(self, advice, num_scored=100)
        require_one_of(self, look_ahead=(1, 2))


@suggests
@dataclass(frozen=True, kw_only=True)
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

    min_information_gain: float | None = None
    max_sd: float | Sequence[float] | None = None
    budget: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.max_sd, Sequence):
            object.__setattr__(self, "max_sd", (*map(float, self.max_sd),))
        limits = (self.min_information_gain, self.max_sd, self.budget)
        require(
            all(np.all(np.array(limit) > 0) for limit in limits if limit is not None),
            "positive limits to stop at",
            self,
            "leave a rule at None that is not wanted",
        )

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
        with forked_generators(derive_seed(seed, "stop")):
            sd = belief.sample(torch.Size([num_draws])).double().std(0)
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


#: Settings whose fields were options of a campaign in the last version.
GROUPS = {"workers": Workers, "details": CampaignDetails}


@takes_loose(**GROUPS)
@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """Sizes and estimators of a campaign.

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

    num_simulations: int = 5_000
    num_samples: int = 1_500
    density_estimator: Any = None
    estimator: Any = "auto"
    refine: bool = True
    network: Literal["each round", "on demand"] = "each round"
    refinement: RefinementOptions = RefinementOptions()
    check_every: int | None = None
    stop: StopRules = StopRules()
    max_simulations: int | None = None
    planned_trials: int = 6
    workers: Workers = IN_PROCESS
    details: CampaignDetails = CampaignDetails()

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "workers", Workers.of(self.workers))
        settings = {"refinement": RefinementOptions, "details": CampaignDetails}
        require_kinds(self, refine=bool, stop=StopRules, **settings)
        find_estimator(self.estimator)  # an unknown name is an error here
        require(
            self.refinement.workers in (IN_PROCESS, self.workers),
            "the refinement's simulations to run as all others of a campaign, "
            f"{self.workers}",
            f"{self.refinement.workers} for them",
            "pass workers to CampaignOptions alone",
        )
        require_one_of(self, network=("each round", "on demand"))
        require_least(self, "use about 5000 a round", num_simulations=100)
        require_least(self, "use about 1500 an action", num_samples=8)
        require_least(self, "use some hundred a trial", max_simulations=100)
        advice = "pass the number of trials that you can run"
        require_least(self, advice, planned_trials=1)
        advice = "use 2 or 3 where the simulator may lack something"
        require_least(self, advice, check_every=1)
