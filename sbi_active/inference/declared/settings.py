"""Settings of the refinement."""

from __future__ import annotations

from dataclasses import dataclass

from sbi_active.expected import require, require_least, suggests
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@suggests
@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """Settings of the refinement.

    Attributes:
        num_histories: Budget of simulated histories, replicates included; a history is
            a parameter set at which each executed action is simulated. Fewer are used
            where the surrogate is good sooner.
            A simulated likelihood may take three times as many.
        num_effective: Number of effective draws that end the sampling of a simulated
            likelihood. The log density of the belief is off by about their number to
            the power -1/2, in nats. Six times as many are taken while they are cheap,
            more of 12 parameters and more, and of a learned likelihood, whose draws
            cost no simulations, 16 times as many.
        num_draws: Number of draws of each proposal of a simulated likelihood; None
            takes a sixth of ``num_histories``, at least 100. Fewer reach a narrow
            posterior in fewer simulations.
        defensive: Share of the prior in the belief, so that no parameter is ruled out
            by an error of the surrogate: a truth that it misses costs log(1 / share)
            nats and not infinitely many. Moments see the share too: .01 of a wide
            prior outweighs a sharp posterior.
        workers: Workers that run the simulations; in a campaign, its own are taken. A
            history of which a row stays lost is left out.
    """

    num_histories: int = 3_000
    num_effective: float = 200
    num_draws: int | None = None
    defensive: float = 1e-5
    workers: Workers = IN_PROCESS

    def __post_init__(self) -> None:
        numbers = {"num_histories": 200, "num_effective": 20, "num_draws": 50}
        require_least(self, "raise it", **numbers, defensive=1e-6)
        share = self.defensive
        require(share <= 0.5, "defensive <= 0.5", share, "use a small share")
