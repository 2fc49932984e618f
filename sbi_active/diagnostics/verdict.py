"""Figures, intervals and a verdict from ranks and gaps of a stratum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from sbi.diagnostics.sbc import check_uniformity_frequentist
from scipy.stats import beta, norm
from torch import Tensor

from sbi_active.diagnostics.calibration import Interval, Stratum, Verdict, worst

LEVELS = (0.5, 0.8, 0.9, 0.95)
NUM_TESTS = 4  # kinds of figures beside the ranks of each parameter


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Tolerances of a verdict.

    Attributes:
        coverage: Error of the coverage of the 90 % regions.
        excluded: Shortfall of that coverage beyond which the verdict is "stop".
        rank_distance: Distance of the ranks' distribution from uniform.
        lost: Share of what outcomes tell.
        gap: Nats below which no share counts.
    """

    coverage: float = 0.05
    excluded: float = 0.1
    rank_distance: float = 0.08
    lost: float = 0.4
    gap: float = 0.1


def judge(
    name: str,
    round_: int,
    ranks: Tensor,
    gap: Tensor,
    gained: Tensor,
    *,
    num_posterior_samples: int,
    level: float,
    tolerance: Tolerance,
    names: Sequence[str],
) -> Stratum:
    r"""Return the figures of a stratum.

    Args:
        name: Name of the stratum.
        round_: Round of the network.
        ranks: Ranks, shape (n, d + 1), the last by density.
        gap: Terms of the log-score gap, shape (n,), nats.
        gained: log q - log b at the truths, shape (n,), nats.
        num_posterior_samples: Number of posterior draws L.
        level: Level of error of one stratum, shared among its figures.
        tolerance: Tolerance of the figures.
        names: Names of the parameters.
    """
    n, dim = len(ranks), ranks.shape[1] - 1
    each = level / (NUM_TESTS + dim)
    # The smallest region that holds the truth has the draws of a higher density.
    credible = 1 - (ranks[:, -1].double() + 0.5) / (num_posterior_samples + 1)
    coverage, intervals = {}, {}
    for c in LEVELS:
        inside = int((credible <= c).sum())
        coverage[c] = inside / n
        intervals[c] = clopper_pearson(inside, n, each)
    uniform = (ranks[:, :dim].double() + 0.5) / (num_posterior_samples + 1)
    distance = [ks_distance(uniform[:, k].numpy()) for k in range(dim)]
    margin = math.sqrt(math.log(2 / each) / (2 * n))
    ranged = [(max(v - margin, 0.0), min(v + margin, 1.0)) for v in distance]
    p_value = check_uniformity_frequentist(ranks[:, :dim], num_posterior_samples)
    mean = float(gap.mean())
    information = float((gap + gained).mean())
    excess = gap - tolerance.lost * (gap + gained).clamp_min(-20)
    reasons: list[tuple[Verdict, str]] = []
    low, high = intervals[0.9]
    if high < 0.9 - tolerance.excluded:
        text = (
            f"90 % regions hold {coverage[0.9]:.0%} of the truths, at most {high:.0%}"
        )
        reasons.append(("stop", f"{text}: it excludes the truth too often"))
    elif high < 0.9 - tolerance.coverage:
        text = (
            f"90 % regions hold {coverage[0.9]:.0%} of the truths, at most {high:.0%}"
        )
        reasons.append(("refine", f"{text}: it is too sure"))
    elif low > 0.9 + tolerance.coverage:
        text = (
            f"90 % regions hold {coverage[0.9]:.0%} of the truths, at least {low:.0%}"
        )
        reasons.append(("refine", f"{text}: it is too wide"))
    for k, (least, _) in enumerate(ranged):
        if least > tolerance.rank_distance:
            text = f"ranks of {names[k]} are {distance[k]:.2f} from uniform"
            reasons.append(("refine", f"{text}, at least {least:.2f}"))
    if _interval(gained, each)[1] < 0:
        text = f"it has {gained.mean():.2f} nats about the truth"
        reasons.append(("stop", f"{text}: the belief before the outcome knew more"))
    if _interval(gap, each)[0] > tolerance.gap and _interval(excess, each)[0] > 0:
        text = f"the log score is {mean:.2f} nats short of {information:.2f}"
        reasons.append(("refine", f"{text} that outcomes tell: it is blunt"))
    return Stratum(
        name=name,
        round=round_,
        num_rows=n,
        coverage=coverage,
        coverage_interval=intervals,
        rank_distance=(*distance,),
        rank_interval=(*ranged,),
        p_value=(*p_value.tolist(),),
        gap=mean,
        gap_interval=_interval(gap, each),
        information=information,
        lost=mean / information if information > 0 else float("nan"),
        verdict=worst([v for v, _ in reasons]),
        reasons=(*(text for _, text in reasons),),
    )


def clopper_pearson(successes: int, n: int, level: float) -> Interval:
    """Return the exact binomial interval of a share (Clopper & Pearson 1934)."""
    k = successes
    low = 0.0 if k == 0 else float(beta.ppf(level / 2, k, n - k + 1))
    high = 1.0 if k == n else float(beta.ppf(1 - level / 2, k + 1, n - k))
    return low, high


def ks_distance(values: np.ndarray) -> float:
    """Return the largest distance of a sample's distribution from uniform."""
    ordered = np.sort(values)
    steps = np.arange(len(ordered) + 1) / len(ordered)
    return float(max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max()))


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
    mean = float(values.mean())
    return mean - half, mean + half
