"""Results of a calibration check: figures, intervals and a verdict by stratum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

import torch
from scipy.stats import binomtest, kstest, norm
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["trust", "refine", "stop"]
Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Stratum:
    """Figures of one group of actions, or of all of them.

    Every interval holds at the same time as all others with the check's level.

    Attributes:
        name: Name of the action or group; "all".
        num_rows: Simulations behind it.
        coverage: Share of truths in the network's smallest 90 % regions.
        coverage_interval: Interval of that share (Clopper & Pearson).
        rank_distance: Largest distance of the ranks' distribution from uniform, one a
            parameter (Kolmogorov & Smirnov).
        rank_margin: Half of the interval of that distance.
        gap: Log-score gap, a lower bound in nats.
        gap_interval: Interval of that bound.
        information: Information that outcomes tell beyond the belief, nats: gap and
            what the network has of it.
        lost: Share of the information that the network loses.
        verdict: Verdict on the stratum, as in :class:`Calibration`.
        reasons: Reasons for the verdict, a clause each.
    """

    name: str
    num_rows: int
    coverage: float
    coverage_interval: Interval
    rank_distance: tuple[float, ...]
    rank_margin: float
    gap: float
    gap_interval: Interval
    information: float
    lost: float
    verdict: Verdict
    reasons: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, repr=False)
class Judged:
    """A verdict with its reasons.

    Attributes:
        verdict: "trust", "refine" or "stop".
        reasons: Reasons for the verdict, a sentence each; empty for "trust".
        parameter_names: Names of the parameters.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    parameter_names: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, in a form that JSON can hold."""
        found = asdict(self)
        return {entry.name: found[entry.name] for entry in fields(self) if entry.repr}

    def __repr__(self) -> str:
        return str(self)


@dataclass(frozen=True, kw_only=True, repr=False)
class Calibration(Judged):
    """Whether an amortized posterior can be trusted, action by action.

    ``print(calibration)`` reports it in words, the verdict first.

    Attributes:
        verdict: Verdict: "trust" if the network passes; "refine" if its regions are off
            or it loses much of the outcomes' information, so that beliefs need the
            simulator or the network more training; "stop" if it excludes the truth too
            often, or is less informative than the belief before.
        reasons: Reasons for the verdict, a sentence each; empty for "trust".
        overall: Figures of all rows.
        strata: Figures by action.
        parameter_names: Names of the parameters.
        gap_method: "likelihood" or "classifier", see :mod:`.log_score`.
        num_invalid: Rows without a measurement that the network cannot take.
        num_simulations: Rows simulated.
        ranks: Ranks of the truths among ``num_posterior_samples``, shape (n, d + 1);
            the last by the network's density.
        num_posterior_samples: Draws of the network a row.
    """

    overall: Stratum
    strata: tuple[Stratum, ...]
    gap_method: str
    num_invalid: int
    num_simulations: int
    ranks: Tensor = field(repr=False)
    num_posterior_samples: int

    @property
    def flagged(self) -> list[str]:
        """Names of the strata that are not to be trusted."""
        return [s.name for s in self.strata if s.verdict != "trust"]

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {describe(self.overall)}"]
        lines += [f"- {reason}" for reason in self.reasons]
        lines += [f"  {s.name}: {describe(s)}" for s in self.strata]
        lines += [f"{self.num_invalid} rows left out"] * (self.num_invalid > 0)
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Draw the ranks of the truths in all rows, as sbi does."""
        from sbi.analysis.plot import sbc_rank_plot

        from sbi_active.display.figures import legible

        num, names = self.num_posterior_samples, [*self.parameter_names]
        ranks = self.ranks[:, :-1]
        drawn = sbc_rank_plot(ranks, num, plot_type="cdf", parameter_labels=names)
        return legible(drawn[0])


def describe(stratum: Stratum) -> str:
    """Return coverage and gap of a stratum with their intervals."""
    low, high = stratum.coverage_interval
    least, most = stratum.gap_interval
    return (
        f"90 % regions hold {stratum.coverage:.0%} of the truths "
        f"({low:.0%} to {high:.0%}), the log score is {stratum.gap:.2f} nats "
        f"({least:.2f} to {most:.2f}) short, {stratum.lost:.0%} of what outcomes tell"
    )


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the strictest of verdicts."""
    order: tuple[Verdict, ...] = ("trust", "refine", "stop")
    return order[max((order.index(v) for v in verdicts), default=0)]


def judge(
    stratum: str,
    ranks: Tensor,
    gap: Tensor,
    gained: Tensor,
    *,
    num_posterior_samples: int,
    level: float,
    names: Sequence[str],
    num_kinds: int = 4,
    off: float = 0.05,
    excluded: float = 0.1,
    uneven: float = 0.08,
    lost: float = 0.4,
    small: float = 0.1,
) -> Stratum:
    r"""Return the figures of a stratum.

    Args:
        stratum: Name of the stratum.
        ranks: Ranks, shape (n, d + 1), the last by density.
        gap: Terms of the log-score gap, shape (n,), nats.
        gained: log q - log b at the truths, shape (n,), nats.
        num_posterior_samples: Number of posterior draws L.
        level: Level of error of one stratum, shared among its figures.
        names: Names of the parameters.
        num_kinds: Number of kinds of figures beside the ranks of each parameter.
        off: Error of the coverage of the 90 % regions that is tolerated.
        excluded: Shortfall of that coverage beyond which the verdict is "stop".
        uneven: Distance of the ranks' distribution from uniform that is tolerated.
        lost: Share of what outcomes tell that may be lost.
        small: Nats below which no share counts.
    """
    n, dim = len(ranks), ranks.shape[1] - 1
    each = level / (num_kinds + dim)
    uniform = (ranks.double() + 0.5) / (num_posterior_samples + 1)
    # The smallest region that holds the truth has the draws of a higher density.
    inside = int((1 - uniform[:, -1] <= 0.9).sum())
    low, high = interval = clopper_pearson(inside, n, each)
    columns = uniform[:, :dim].T.numpy()
    distance = [float(kstest(c, "uniform", method="asymp").statistic) for c in columns]
    margin = math.sqrt(math.log(2 / each) / (2 * n))
    mean = float(gap.mean())
    information = float((gap + gained).mean())
    excess = gap - lost * (gap + gained).clamp_min(-20)
    reasons: list[tuple[Verdict, str]] = []
    text = f"90 % regions hold {inside / n:.0%} of the truths, at"
    if high < 0.9 - excluded:
        word = f"most {high:.0%}: it excludes the truth too often"
        reasons.append(("stop", f"{text} {word}"))
    elif high < 0.9 - off:
        reasons.append(("refine", f"{text} most {high:.0%}: it is too sure"))
    elif low > 0.9 + off:
        reasons.append(("refine", f"{text} least {low:.0%}: it is too wide"))
    for name, far in zip(names, distance, strict=True):
        if far - margin > uneven:
            text = f"ranks of {name} are {far:.2f} from uniform"
            reasons.append(("refine", f"{text}, at least {far - margin:.2f}"))
    if _interval(gained, each)[1] < 0:
        text = f"it has {gained.mean():.2f} nats about the truth"
        reasons.append(("stop", f"{text}: the belief before the outcome knew more"))
    if _interval(gap, each)[0] > small and _interval(excess, each)[0] > 0:
        text = f"the log score is {mean:.2f} nats short of {information:.2f}"
        reasons.append(("refine", f"{text} that outcomes tell: it is blunt"))
    return Stratum(
        name=stratum,
        num_rows=n,
        coverage=inside / n,
        coverage_interval=interval,
        rank_distance=(*distance,),
        rank_margin=margin,
        gap=mean,
        gap_interval=_interval(gap, each),
        information=information,
        lost=mean / information if information > 0 else float("nan"),
        verdict=worst([v for v, _ in reasons]),
        reasons=(*(text for _, text in reasons),),
    )


def clopper_pearson(successes: int, n: int, level: float) -> Interval:
    """Return the exact binomial interval of a share (Clopper & Pearson 1934)."""
    low, high = binomtest(successes, n).proportion_ci(1 - level)
    return float(low), float(high)


def _interval(values: Tensor, level: float) -> Interval:
    """Return the normal interval of a mean, without the farthest of terms.

    Single terms of a log score may be tens of nats; they are cut at the 1 % and 99 %
    points, which moves a lower bound of the gap down.
    """
    values = values.double()
    if len(values) >= 50:
        ends = values.quantile(torch.tensor([0.01, 0.99], dtype=torch.float64))
        values = values.clamp(ends[0], ends[1])
    half = float(norm.isf(level / 2)) * float(values.std()) / len(values) ** 0.5
    return float(values.mean()) - half, float(values.mean()) + half
