"""Whether the simulator still explains the trials, judged as they come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from sbi_active.campaign.state import CampaignState
from sbi_active.inference.refinement.regression_error import LARGE

Health = Literal["ok", "watch", "alarm"]

#: Probability of an alarm at any time while the simulator is right, half of it by each
#: of the two tests; of a watch.
ALARM, WATCH = 0.05, 0.25


def assess(state: CampaignState) -> Health:
    r"""Return "ok", "watch" or "alarm" for the current model.

    Two tests, each at half the level. The first bets against the predictions: with
    surprises :math:`p_t` uniform given the past,

    .. math::
        E_t = \prod_{s \le t} e(p_s), \qquad
        e(p) = \int_0^1 \kappa p^{\kappa - 1} d\kappa
        = \frac{1 - p + p \log p}{p (\log p)^2}

    is a martingale of mean 1, which ever exceeds :math:`1 / \alpha` with a probability
    of at most :math:`\alpha`, however many trials follow. The second is the misfit
    of the refined belief to all trials, :math:`m_t < \alpha / (t (t + 1))`, whose
    levels add up to :math:`\alpha`. Alarms stay until another model is adopted.

    Args:
        state: State of the campaign. Only trials count that the current model
            scored under a belief with at most 0.2 nats of simulation error
            (``error_nats_if_explained`` of its diagnostics); a worse belief predicts
            wrongly even if the simulator is right.

    References:
        Vovk & Wang, Annals of Statistics 2021 (e-values from p-values); Ville, Etude
        critique de la notion de collectif, 1939.
    """
    version = state.version
    trials = [t for t in state.measured if t.version == version.number]
    surprises = [
        t.surprise
        for t in trials
        if t.surprise is not None and (t.belief_error or 0.0) <= LARGE
    ]
    misfits = [version.misfit, *[t.misfit for t in trials]]
    bets, total = [0.0], 0.0
    for surprise in surprises:
        total += log_e_value(surprise)
        bets.append(total)
    if max(bets) >= math.log(2 / ALARM) or _exceeds(misfits, ALARM / 2):
        return "alarm"
    if bets[-1] >= math.log(2 / WATCH) or _exceeds(misfits, WATCH / 2):
        return "watch"
    return "ok"


def log_e_value(p: float) -> float:
    """Return the log of e(p), nats; log 1/2 at p = 1.

    Args:
        p: Tail probability in (0, 1].

    Example:
        >>> round(log_e_value(1e-3), 2), round(log_e_value(0.5), 2)
        (3.03, -0.45)
    """
    log_p = math.log(p)
    if p > 1 - 1e-4:  # the expansion at 1, where the formula is 0 / 0
        return math.log(0.5 + (1 - p) / 6)
    return math.log(1 - p + p * log_p) - log_p - 2 * math.log(-log_p)


def _exceeds(misfits: Sequence[float | None], level: float) -> bool:
    known = [m for m in misfits if m is not None]
    return any(m < level / (t * (t + 1)) for t, m in enumerate(known, 1))
