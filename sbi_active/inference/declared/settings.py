"""Settings of the refinement."""

from __future__ import annotations

from attrs import field, frozen

from sbi_active.expected import at_least, at_most, of_class, suggests
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@suggests
@frozen(kw_only=True, slots=False)
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
        defensive: Share of the prior in the belief, so that no parameter is ruled out
            by an error of the surrogate: a truth that it misses costs log(1 / share)
            nats and not infinitely many. ``sample`` sees the share too; moments,
            tables and stop rules, which it would outweigh, are of the posterior.
        workers: Workers that run the simulations; in a campaign, its own are taken. A
            history of which a row stays lost is left out.
    """

    num_histories: int = field(default=3_000, validator=at_least(200))
    num_effective: float = field(default=200, validator=at_least(20))
    defensive: float = field(
        default=1e-5,
        validator=[at_least(1e-6), at_most(0.5, "use a small share")],
    )
    workers: Workers = field(default=IN_PROCESS, validator=of_class(Workers))
