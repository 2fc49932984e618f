"""What a way found, beside the answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.oracles.problem import Array, Problem
from tests.oracles.reference import Answer

#: Draws a parameter within a region, below which their moments say little.
FEWEST = 50


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a way found.

    Attributes:
        theta: Draws of the belief, shape (n, d).
        log_evidence: log Z, nats; None where the way gives none.
        error: Its own standard error, nats.
        trustworthy: What it says of itself; None where it says nothing.
        kind: Class of the belief, which tells the engine behind it.
    """

    theta: Array
    log_evidence: float | None = None
    error: float = 0.0
    trustworthy: bool | None = None
    kind: str = ""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """From where on a belief or an evidence is wrong.

    Attributes:
        shift: Error of a mean, in standard deviations. .3 is what a belief's flag
            promises to tell; 5,000 draws of ten parameters err by .04, so that half
            would do for exact engines, and twice passes beliefs at a wrong place.
        kl: Divergence of normal fits, nats. .1 is a shift of .45, or a width off by
            25 %, in one parameter; half also tells draws of twenty parameters from
            one another, twice passes a noise that is halved.
        region: Error of the probability of a region. Beliefs of 1,000 independent
            draws err by .016; half tells these, twice passes a small mode dropped.
        evidence: Error of a log evidence, in standard errors of its own and of the
            reference together. Beyond four by chance once in 16,000.
        least: Standard error that an evidence is granted at least, nats: no verdict
            changes by four times as much.
    """

    shift: float = 0.3
    kl: float = 0.1
    region: float = 0.05
    evidence: float = 4.0
    least: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Judged:
    """The error of what was found.

    Attributes:
        kl: Divergence of normal fits, the answer's from that found, nats: of all
            parameters, or within a region where that is larger.
        shift: Largest error of a mean, in standard deviations.
        narrowest: Least ratio of a standard deviation to the exact one.
        widest: The largest ratio.
        region: Largest error of the probability of a region.
        evidence: Error of the log evidence in standard errors; NaN without one.
    """

    kl: float
    shift: float
    narrowest: float
    widest: float
    region: float
    evidence: float

    def faults(self) -> list[str]:
        """Return what is wrong, by name; nothing where all holds."""
        most = Limits()
        off = {
            "kl": not self.kl <= most.kl,
            "shift": not self.shift <= most.shift,
            "region": not self.region <= most.region,
            "evidence": abs(self.evidence) > most.evidence,
        }
        return [name for name, is_off in off.items() if is_off]


def judged(own: Problem, answer: Answer, found: Found) -> Judged:
    """Return the error of what was found, a standard error of .05 granted to evidence.

    Args:
        own: The problem.
        answer: What is known of it.
        found: What a way says.
    """
    theta, sd = found.theta, np.sqrt(np.diag(answer.cov))
    label = own.region(theta)
    apart, within = [0.0], [divergence(answer.mean, answer.cov, theta)]
    for k, region in answer.regions.items():
        inside = theta[label == k]
        apart.append(abs(len(inside) / len(theta) - region.probability))
        if len(inside) > FEWEST * own.dim:
            within.append(divergence(region.mean, region.cov, inside))
    apart.append(float((~np.isin(label, [*answer.regions])).mean()))
    evidence = np.nan
    if found.log_evidence is not None:
        error = np.linalg.norm([max(found.error, Limits.least), answer.error])
        evidence = (found.log_evidence - answer.log_evidence) / error
    ratio = theta.std(0) / sd
    return Judged(
        kl=max(within),
        shift=float((np.abs(theta.mean(0) - answer.mean) / sd).max()),
        narrowest=float(ratio.min()),
        widest=float(ratio.max()),
        region=float(max(apart)),
        evidence=float(evidence),
    )


def divergence(mean: Array, cov: Array, theta: Array) -> float:
    """Return the KL divergence of a normal fit to draws from a normal, nats.

    Parameters that are constant, as one of a few values within its region, are left
    out.
    """
    varies = np.diag(cov) > 1e-16 * (1 + mean**2)  # rounding leaves less
    mean, cov, theta = mean[varies], cov[np.ix_(varies, varies)], theta[:, varies]
    sd = np.sqrt(np.diag(cov))
    one, gap = cov / np.outer(sd, sd), (theta.mean(0) - mean) / sd
    # The floor lets draws without width have a divergence, a large one.
    other = np.atleast_2d(np.cov((theta / sd).T)) + 1e-10 * np.eye(len(mean))
    inverse = np.linalg.inv(other)
    volume = np.linalg.slogdet(other)[1] - np.linalg.slogdet(one)[1]
    trace = np.trace(inverse @ one) - len(mean)
    return float((trace + gap @ inverse @ gap + volume) / 2)
