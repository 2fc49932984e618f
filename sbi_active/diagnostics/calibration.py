"""Results of a calibration check, stratum by stratum, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["trust", "refine", "stop"]
Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Stratum:
    """Figures of one group of actions in one round, or of all of them.

    Every interval holds at the same time as all others with the check's level.

    Attributes:
        name: Name of the action or group; "all".
        round: Round of the network, from 1; 0 for all.
        num_rows: Simulations behind it.
        coverage: Share of truths in the network's smallest regions, by their level.
        coverage_interval: Interval of each of these shares (Clopper & Pearson).
        rank_distance: Largest distance of the ranks' distribution from uniform, one a
            parameter (Kolmogorov & Smirnov).
        rank_interval: Interval of that distance, one a parameter.
        p_value: Probability that ranks of uniform ones are as far, one a parameter, as
            sbi gives.
        gap: Log-score gap, a lower bound in nats.
        gap_interval: Interval of that bound.
        information: Information that outcomes tell beyond the belief, nats: gap and
            what the network has of it.
        lost: Share of the information that the network loses.
        verdict: Verdict on the stratum, as in :class:`Calibration`.
        reasons: Reasons for the verdict, a clause each.
    """

    name: str
    round: int
    num_rows: int
    coverage: dict[float, float]
    coverage_interval: dict[float, Interval]
    rank_distance: tuple[float, ...]
    rank_interval: tuple[Interval, ...]
    p_value: tuple[float, ...]
    gap: float
    gap_interval: Interval
    information: float
    lost: float
    verdict: Verdict
    reasons: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Whether an amortized posterior can be trusted, action by action.

    ``print(calibration)`` reports it in words, the verdict first.

    Attributes:
        verdict: Verdict: "trust" if the network passes; "refine" if its regions are off
            or it loses much of the outcomes' information, so that beliefs need the
            simulator or the network more training; "stop" if it excludes the truth too
            often, or is less informative than the belief before.
        reasons: Reasons for the verdict, a sentence each; empty for "trust".
        overall: Figures of all rows.
        strata: Figures by action and round.
        parameter_names: Names of the parameters.
        gap_method: "likelihood" or "classifier", see :mod:`.log_score`.
        num_invalid: Rows without a measurement that the network cannot take.
        num_simulations: Rows simulated.
        ranks: Ranks of the truths among ``num_posterior_samples``, shape (n, d + 1);
            the last by the network's density.
        num_posterior_samples: Draws of the network a row.
        label: Index of each row's stratum, shape (n,).
        tarp: Expected coverage and credibility by distances to random points (Lemos et
            al. 2023), of all rows.
        tarp_area: Area between these from .5 up; negative for too narrow a posterior.
        local: p-values that the posterior is right at given outcomes, where asked for.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    overall: Stratum
    strata: tuple[Stratum, ...]
    parameter_names: tuple[str, ...]
    gap_method: str
    num_invalid: int
    num_simulations: int
    ranks: Tensor = field(repr=False)
    num_posterior_samples: int
    label: Tensor = field(repr=False)
    tarp: tuple[Tensor, Tensor] = field(repr=False)
    tarp_area: float
    local: tuple[float, ...] = ()

    @property
    def flagged(self) -> list[str]:
        """Names of the strata that are not to be trusted."""
        return [s.name for s in self.strata if s.verdict != "trust"]

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, in a form that JSON can hold."""
        found = asdict(self)
        return {entry.name: found[entry.name] for entry in fields(self) if entry.repr}

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {describe(self.overall)}"]
        lines += [f"- {reason}" for reason in self.reasons]
        lines += [f"  {s.name}: {describe(s)}" for s in self.strata]
        if self.num_invalid:
            lines.append(f"{self.num_invalid} rows without a measurement left out")
        return "\n".join(lines)

    __repr__ = __str__

    def plot(self) -> Figure:
        """Draw ranks as sbi does, coverage, and gaps and coverage by stratum."""
        from sbi_active.diagnostics.figure import plot_calibration
        from sbi_active.display.figures import legible

        return legible(plot_calibration(self))


def describe(stratum: Stratum) -> str:
    """Return coverage and gap of a stratum with their intervals."""
    low, high = stratum.coverage_interval[0.9]
    least, most = stratum.gap_interval
    return (
        f"90 % regions hold {stratum.coverage[0.9]:.0%} of the truths "
        f"({low:.0%} to {high:.0%}), the log score is {stratum.gap:.2f} nats "
        f"({least:.2f} to {most:.2f}) short, {stratum.lost:.0%} of what outcomes tell"
    )


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the strictest of verdicts."""
    order: tuple[Verdict, ...] = ("trust", "refine", "stop")
    return order[max((order.index(v) for v in verdicts), default=0)]
