"""Look at single cases again: what raised the alarm, and whether the evidence holds.

    python -m benchmarks criticism.recheck --world B --kind library --case 8 9 21
    python -m benchmarks criticism.recheck --kind removed --trials 12 --case 15

One row a case. log BF: lower end of the Bayes factor's error, which raises the alarm
above 3.0; p: of the bare model's chi-square; p after: of the verdict's, its parameters
off the degrees of freedom. Evidence of the verdict and, where it is declared, of the
truth: as the loop has it, and by importance sampling with many draws from a Gaussian of
four times the posterior's covariance and a third from the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from scipy.special import logsumexp
from scipy.stats import chi2, multivariate_normal

from benchmarks.criticism.cases import Kind, draw_case
from benchmarks.criticism.worlds import get_world
from sbi_active.criticism import Criticism
from sbi_active.criticism.evidence import RivalSet
from sbi_active.criticism.results import ModelKey

WIDER = 4.0  # covariance of the proposal by that of the posterior
BLOCK = 1_000  # parameters simulated at a time


def evidence_again(
    rivals: RivalSet, names: tuple[str, ...], num_draws: int
) -> tuple[float, float]:
    """Return the log evidence as the loop has it, and by many draws.

    Args:
        rivals: The models, traced.
        names: Of the effects.
        num_draws: A third of them from the prior.
    """
    fit = rivals.fit(ModelKey((*names,)))
    rival, sample, evidence = fit.rival, fit.sample, fit.evidence
    weight = sample.weight / sample.weight.sum()
    center = weight @ sample.u
    covariance = WIDER * np.cov(sample.u.T, aweights=weight, ddof=0)
    wide = multivariate_normal(
        center,
        covariance,  # pyright: ignore[reportArgumentType]
        allow_singular=True,
    )
    num_wide = 2 * num_draws // 3
    c = rival.coordinates
    u = np.concatenate(
        [
            wide.rvs(num_wide, random_state=0).reshape(num_wide, -1),
            c.sample(num_draws - num_wide, seed=1),
        ]
    )
    log_p = c.log_prob(u)
    shares = np.log([num_wide / num_draws, 1 - num_wide / num_draws])
    log_q = np.logaddexp(shares[0] + wide.logpdf(u), shares[1] + log_p)
    log_weight = np.full(num_draws, -np.inf)
    inside = np.flatnonzero(np.isfinite(log_p))
    for rows in np.array_split(inside, max(1, len(inside) // BLOCK)):
        log_weight[rows] = rival.log_likelihood(u[rows]) + log_p[rows] - log_q[rows]
    return evidence.log_evidence, float(logsumexp(log_weight) - np.log(num_draws))


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        case: Number of the case.
        world: Name of the world.
        kind: Kind of cases.
        trials: Number of trials.
        draws: Number of draws.
    """

    case: Sequence[int]
    world: Literal["A", "B", "C"] = "B"
    kind: Kind = "library"
    trials: int = 8
    draws: int = 30_000


def main(arguments: Settings) -> None:
    """Print the table."""
    world, rows = get_world(arguments.world), []
    for number in arguments.case:
        case = draw_case(world, arguments.kind, number, num_trials=arguments.trials)
        problem = case.problem
        loop = Criticism(
            problem.model,
            problem.prior,
            problem.trials,
            effects=problem.effects,
            actions=problem.actions,
            seed=number,
        )
        detection, tracing = loop.detect(), loop.trace()
        found = tracing.evidences[tracing.verdict]
        freedom = len(loop.rivals.measurements) - len(found.names)
        again = [
            "{:.2f} {:.2f}".format(*evidence_again(loop.rivals, names, arguments.draws))
            if names and {*names} <= {*loop.rivals.effects}
            else ""
            for names in (tracing.chosen, case.truth.names)
        ]
        after = chi2.sf(found.best_chi_square, freedom) if tracing.chosen else np.nan
        rows.append(
            [
                *(number, " + ".join(case.truth.names), tracing.verdict),
                *(f"{detection.lower:.2f}", f"{detection.p_value:.2g}"),
                *(f"{after:.2g}", *again),
            ]
        )
    header = ["case", "truth", "verdict", "log BF", "p", "p after"]
    header += ["evidence, again: verdict", "evidence, again: truth"]
    print(pd.DataFrame(rows, columns=pd.Index(header)).to_string(index=False))
