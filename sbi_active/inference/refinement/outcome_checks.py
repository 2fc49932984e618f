"""Whether what trials did, give a measurement or none, is as simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.surrogate import Surrogate

Array = NDArray[Any]

LIVE = 0.01  # mass below which a region is left out
BLURRED = 0.05  # share of repeated simulations that would differ, beyond those that do
UNHEARD = 0.01  # probability of an outcome that calls for a warning


def check_outcomes(
    diagnostics: Diagnostics, surrogate: Surrogate, draws: Array, pool: Histories
) -> Diagnostics:
    r"""Return a belief's diagnostics with figures on trials without a measurement.

    ``probability_of_outcome`` is :math:`E_b[P(\text{as observed} | \theta)]` of each
    trial, over draws of the belief (n, d). Near zero, the trial did what simulations
    near the belief do not do: the simulator lacks a way of failing, or a fault was told
    as "invalid". The assumption "outcomes_followed" compares repeated simulations:
    where those agree and the regression expects them to differ, it misses an edge.
    """
    share = pool.agrees.mean(0) if len(pool) else np.ones(0)
    # A trial in which simulations all agree, or none does, was not regressed.
    total = np.where((share > 0) & (share < 1), 0.0, share * len(draws))
    label = surrogate.assign(draws)
    blur = 0.0
    for k, fit in enumerate(surrogate.regressions):
        z = draws[label == k]
        for outcome in fit.outcomes:
            total[outcome.trial] += np.exp(outcome.log_prob(z)).sum()
            if len(z) > LIVE * len(draws):
                blur = max(blur, outcome.blur)
    probability = [float(p) for p in total / len(draws)]
    followed = blur <= BLURRED
    texts = []
    if not followed:
        texts.append(
            "SA120 where simulations have a measurement and where they have none is "
            f"followed coarsely ({blur:.0%} of repeated simulations would differ that "
            "do not), so that the belief is too wide; raise num_histories"
        )
    unheard = [k for k, p in enumerate(probability) if p < UNHEARD]
    if unheard:
        texts.append(
            f"SA121 trials {', '.join(map(str, unheard))} had a measurement, or none, "
            f"where less than {UNHEARD:.0%} of the simulations near the belief do the "
            "same: the simulator lacks a way to fail, or the status of the trial is "
            "wrong"
        )
    assumption = Assumption(followed, float(blur))
    return diagnostics.extended(
        probability_of_outcome=probability,
        num_missing=pool.num_missing,
        assumptions={**diagnostics.assumptions, "outcomes_followed": assumption},
    ).warned(*texts)
