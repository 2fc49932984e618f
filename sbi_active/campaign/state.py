"""The state of a campaign: plain data, from which everything else follows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from torch import Tensor

from sbi_active.designer import Design
from sbi_active.inference.mixture_density import MixtureDensity
from sbi_active.inference.refine import Refinement

__all__ = ["CampaignOptions", "CampaignState", "Status", "Trial"]

Status = Literal["pending", "ok", "invalid", "missing"]


@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """Sizes and estimators of a campaign.

    Attributes:
        num_simulations: Rows a round to train on.
        num_samples: Simulations a candidate action for the expected information gain,
            half to choose and half to report.
        density_estimator: As in :class:`~sbi_active.ASBI`.
        estimator: Of the expected information gain, as in
            :class:`~sbi_active.InformationGainDesigner`; "posterior" is the paper's.
        eliminate: Whether candidates far behind the leader get no further samples.
        refine: Whether a belief is refined with the simulator after each trial; without
            it, beliefs are chained as in the paper.
        refinement: Settings of the refinement; those of its simulations are taken from
            here.
        num_workers: Of the simulations of training and refinement, see
            :func:`~sbi_active.simulation.simulate`.
        time_limit: Seconds a simulated row may take; None waits for ever. With it, or
            with more than one worker, a simulator that ends its process costs a row.
        num_retries: How often a row that a fault lost is tried again.
    """

    num_simulations: int = 5_000
    num_samples: int = 1_500
    density_estimator: Any = None
    estimator: Any = "auto"
    eliminate: bool = True
    refine: bool = True
    refinement: Refinement = Refinement()
    num_workers: int = 1
    time_limit: float | None = None
    num_retries: int = 0

    @property
    def engine(self) -> dict[str, Any]:
        """Options of :func:`~sbi_active.simulation.simulate`."""
        return {
            "num_workers": self.num_workers,
            "time_limit": self.time_limit,
            "num_retries": self.num_retries,
        }

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
            eliminate=False,
            refine=False,
        )

    def __post_init__(self) -> None:
        if self.num_simulations < 100:
            raise ValueError(
                f"expected num_simulations >= 100; got {self.num_simulations}; do use "
                "about 5000 a round"
            )


@dataclass(frozen=True)
class Trial:
    """One trial on the real system.

    Attributes:
        index: Position in the campaign, from 0.
        action: The action asked for and, once told, the one executed, (action_dim,).
        x: The outcome, shape x_shape; None while pending or missing.
        status: "pending"; "ok"; "invalid" where the trial ran and gave no measurement,
            which is information; "missing" where a fault unrelated to the parameters
            hit it, which is ignored.
        design: The design behind the action; None where the trial was not asked for.
        information_gained: Realized, KL(belief after || before) in nats.
        seconds: Wall time by stage.
        cpu_seconds: CPU time by stage.
        num_simulations: Simulations spent on this trial.
        num_missing: Those of them lost to faults of the simulator, in training and
            refinement.
    """

    index: int
    action: Tensor
    x: Tensor | None = None
    status: Status = "pending"
    design: Design | None = None
    information_gained: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    num_simulations: int = 0
    num_missing: int = 0


@dataclass
class CampaignState:
    """All that a campaign is: with the simulator, the rest can be computed again.

    Attributes:
        method: Name of the method.
        seed: Of everything random.
        options: Sizes and estimators.
        trials: In the order in which they were asked for or told.
        processed: Indices of trials that the belief contains, in order of use.
    """

    method: str
    seed: int
    options: CampaignOptions
    trials: list[Trial] = field(default_factory=list)
    processed: list[int] = field(default_factory=list)
