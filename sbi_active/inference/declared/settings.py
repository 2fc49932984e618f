"""Settings of the refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """Settings of the refinement.

    Attributes:
        num_histories: Budget of simulated histories, replicates included; a history is
            a parameter set at which each executed action is simulated. Fewer are used
            where the surrogate is good sooner. A trial that had a measurement is
            simulated again, up to 16 times, where by chance simulations have none.
            A simulated likelihood may take three times as many.
        num_effective: Effective draws that end the sampling of a simulated likelihood.
            The log density of the belief is off by about their number to the power
            -1/2, in nats.
        num_draws: Of each proposal of a simulated likelihood; None takes a sixth of
            ``num_histories``, at least 100. Fewer reach a narrow posterior in fewer
            simulations.
        defensive: Share of the prior in the belief, so that no parameter is ruled out
            by an error of the surrogate: a truth that it misses costs log(1 / share)
            nats and not infinitely many. Moments see the share too: .01 of a wide
            prior outweighs a sharp posterior.
        first_share: Share of the budget for the first stage, over the whole prior. It
            must find every mode; what it spends is lost where the posterior is narrow.
        stage_share: Share for each later stage.
        replicate_share: Share of a stage simulated twice, which tells noise from
            misfit.
        num_particles: Number of draws from a learned likelihood, which cost no
            simulations; two in five are to be effective. Half raises the error of a log
            density from .018 to .025 nats. More are taken beyond six parameters, in
            proportion to these.
        max_regions: Ellipsoids at most, but for splits against misfit.
        check_order: Refine a second time, with the trials in reverse and new
            simulations, and report the divergence between the two: what the order and
            the draws contribute. It doubles the cost. A simulated likelihood has no
            order and no such check.
        checked_share: Share of the budget that is simulated beyond it, to compare a
            learned belief with simulations that it was not fitted to. A mean is then
            known to about .06 standard deviations at 3,000 histories; with half the
            share to .08.
        largest_shift: Error of a learned belief's mean, in standard deviations, beyond
            which it is not trusted, or three standard errors of the check where these
            are more. Less than the .3 that a user may see, by two standard errors at
            3,000 histories.
        contradiction_level: Tail probability of the best fit's residuals under the
            declared noise, below which the noise is inflated to what trials show. A
            right simulator crosses it once in a million updates; half and twice are
            the same in practice, since contradictions lie far below.
        workers: Of the simulations; in a campaign, its own are taken. A history of
            which a row stays lost is left out.
    """

    num_histories: int = 3_000
    num_effective: float = 200
    num_draws: int | None = None
    defensive: float = 1e-5
    first_share: float = 0.25
    stage_share: float = 0.15
    replicate_share: float = 0.2
    num_particles: int = 8_000
    max_regions: int = 8
    check_order: bool = False
    checked_share: float = 0.1
    largest_shift: float = 0.2
    contradiction_level: float = 1e-6
    workers: Workers = IN_PROCESS

    @property
    def effective_particles(self) -> float:
        """Number of effective draws asked of a learned likelihood."""
        return 0.4 * self.num_particles

    def __post_init__(self) -> None:
        for name, low, high in (
            ("num_histories", 200, np.inf),
            ("num_effective", 20, np.inf),
            ("num_draws", 50, np.inf),
            ("defensive", 1e-6, 0.5),
            ("first_share", 0.05, 1.0),
            ("stage_share", 0.02, 1.0),
            ("replicate_share", 0.05, 0.5),
            ("num_particles", 1_000, np.inf),
            ("max_regions", 1, 32),
            ("checked_share", 0.0, 1.0),
            ("largest_shift", 0.0, np.inf),
            ("contradiction_level", 0.0, 0.01),
        ):
            value = getattr(self, name)
            if name == "num_draws" and value is None:
                continue
            if not low <= value <= high:
                raise ValueError(
                    f"expected {name} in [{low:g}, {high:g}]; got {value}; choose "
                    "a value in this range"
                )
