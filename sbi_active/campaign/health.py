"""Whether the simulator still explains the trials: all of them, and each.

The health judges the trials together as they come. Single outcomes that nothing in the
prior explains are named and left out.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.campaign.state import FAR, CampaignState, Trial, first_numbers
from sbi_active.campaign.telling import Health
from sbi_active.inference.beliefs.belief import UnchangedBelief
from sbi_active.inference.beliefs.diagnostics import Diagnostics


def assess(state: CampaignState, *, alarm: float = 0.05, watch: float = 0.25) -> Health:
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
        alarm: Probability of an alarm at any time while the simulator is right, half of
            it by each of the two tests.
        watch: Probability of a watch, likewise.

    References:
        Vovk & Wang, Annals of Statistics 2021 (e-values from p-values); Ville, Etude
        critique de la notion de collectif, 1939.
    """
    trials = [t for t in state.measured if t.version == state.version.number]
    bet = largest_bet = 0.0
    for trial in trials:
        if trial.surprise is not None and not is_off(trial.belief_error or 0.0):
            bet += log_e_value(trial.surprise)
            largest_bet = max(largest_bet, bet)
    misfits = [state.version.misfit, *(t.misfit for t in trials)]
    known = enumerate((m for m in misfits if m is not None), 1)
    least = min((m * t * (t + 1) for t, m in known), default=math.inf)
    if largest_bet >= math.log(2 / alarm) or least < alarm / 2:
        return "alarm"
    if bet >= math.log(2 / watch) or least < watch / 2:
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


def misfit(diagnostics: Diagnostics) -> float | None:
    """Return a belief's tail probability, of all trials or the worst, both counted.

    Args:
        diagnostics: Diagnostics of the belief. The result is None without tail
            probabilities, and where the belief is off by more than a test of the
            simulator can bear.
    """
    each, joint = diagnostics.tail_probability_of_trial, diagnostics.tail_probability
    if joint is None or is_off(error_nats(diagnostics)):
        return None
    return min(1.0, 2 * min(joint, len(each) * min(each)))


def is_off(error: float, *, most: float = 0.2) -> bool:
    """Return whether a belief is off by more nats than a test by it can bear.

    Args:
        error: Expected divergence from the belief of endless simulations, nats.
        most: Number of nats that a test can bear (a choice).
    """
    return error > most


def error_nats(diagnostics: Diagnostics) -> float:
    """Return the nats that a belief is off as its simulations are few, 0 if unknown."""
    modes = diagnostics.assumptions.get("few_modes")
    if modes is not None and not modes.holds:
        return math.inf  # whatever the other figures say of those that were found
    return diagnostics.error_nats_if_explained or 0.0


def is_suspect(trial: Trial, suspect: float = 0.01) -> bool:
    """Return whether a trial may lie where nothing in the prior leads.

    Args:
        trial: Scored trial.
        suspect: Surprise below which it may.
    """
    known = trial.surprise is not None and trial.outlyingness is None
    return not known or (trial.surprise or 0.0) < suspect


def outlyingness(x: Tensor, drawn: Tensor, *, constant: float = 1e-6) -> float:
    r"""Return how far an outcome lies beyond all simulations, in their range.

    .. math::
        \max_j \frac{\max(x_j - \max_i x_{ij},\; \min_i x_{ij} - x_j,\; 0)}
        {\max_i x_{ij} - \min_i x_{ij}}

    over the numbers j that were measured; infinite if no simulation had one of them.
    The range of a number that never varies is its size.

    Args:
        x: The outcome, shape x_shape; NaN where nothing was measured.
        drawn: Simulated outcomes, shape (n, *x_shape).
        constant: Range over size below which a number counts as one that never varies.

    Example:
        >>> outlyingness(torch.tensor([3.0]), torch.tensor([[0.0], [0.5], [1.0]]))
        2.0
    """
    observed, rows = x.double().flatten(), drawn.double().flatten(1)
    own = observed.isfinite()
    observed, rows = observed[own], rows[:, own]
    present = rows.isfinite()
    if not len(observed):
        return 0.0
    if not bool(present.any(0).all()):
        return math.inf
    low = torch.where(present, rows, torch.inf).amin(0)
    high = torch.where(present, rows, -torch.inf).amax(0)
    size = torch.maximum(low.abs(), high.abs())
    width = torch.where(high - low > constant * size, high - low, size)
    # A number that is always zero has no size of its own.
    width = torch.where(width > 0, width, width.amax().clamp_min(1e-30))
    beyond = torch.maximum(observed - high, low - observed).clamp_min(0.0)
    return float((beyond / width).max())


def doubts(trials: Sequence[Trial], notable: float = 0.1) -> list[str]:
    """Return the doubts about trials beyond all simulations, with advice.

    Args:
        trials: Trials to be judged.
        notable: Ranges beyond all simulations that are worth a word.
    """
    return [
        _doubt(t) for t in trials if t.is_measured and (t.outlyingness or 0.0) > notable
    ]


def in_doubt(
    belief: Distribution, prior: Distribution, texts: Sequence[str]
) -> Distribution:
    """Return the same belief, marked untrustworthy for reasons.

    Args:
        belief: Belief from the trials that are explained; the prior before any.
        prior: The original prior.
        texts: Reasons from :func:`doubts`.
    """
    if hasattr(belief, "diagnostics"):
        marked: Any = copy.copy(belief)
    else:
        marked = UnchangedBelief(prior, belief)
    known = marked.diagnostics
    marked.diagnostics = known.extended(warnings=()).warned(*texts, *known.warnings)
    return marked


def _doubt(trial: Trial) -> str:
    far, index = trial.outlyingness or 0.0, trial.index
    action, x = map(first_numbers, (trial.action, trial.x))
    where = f"trial {index} at action [{action}]: x = [{x}] "
    if math.isinf(far):
        what = "has numbers that no simulation from the prior has"
    else:
        what = (
            f"is {far:.3g} times the range of the simulations from the prior away from "
            "anything simulated"
        )
    so = ", so that the belief leaves it out" if far > FAR else ""
    return (
        f"SA102 {where}{what}{so}; correct or withdraw trial {index}, and criticize "
        "where it is right"
    )
