"""Whether the bare model, refitted, misses the data."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from sbi_active.criticism.errors import log_sum_exp
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, Detection
from sbi_active.criticism.rival_set import RivalSet
from sbi_active.criticism.unknown_scale import log_evidence

__all__ = ["THRESHOLD", "detect"]

#: Log Bayes factor of an alarm: under the bare model's prior predictive it is exceeded,
#: at any stopping time, with a probability of at most 1/20.
THRESHOLD = float(np.log(20.0))
#: Standard errors by which the Bayes factor must exceed the threshold.
MARGIN = 2.0


def detect(rivals: RivalSet) -> Detection:
    r"""Return the Bayes factor of everything else against the bare model.

    .. math::
        \log B = \log \frac1m \sum_{k=1}^m Z_k - \log Z_0

    over all effects, with priors of unknown scale, the residual process and noise
    inflation. Before an alarm, the
    bare model's evidence is computed again by tempering, since a mode that the
    least-squares search missed would be a false alarm.

    Args:
        rivals: The models.

    References:
        Ville, Etude critique de la notion de collectif (1939), for any stopping time.
    """
    null = rivals.evidence()
    # First what can explain anything: beside it, a hopeless effect is soon dismissed.
    others = [log_evidence(rivals, error=e) for e in (UNEXPLAINED, SCATTER)]
    others += [log_evidence(rivals, (name,)) for name in rivals.effects]
    first = null.log_evidence
    log_b, error = bayes_factor(others, log_evidence(rivals))
    check = None
    if log_b - MARGIN * error > THRESHOLD:
        check = rivals.tempered().log_evidence
        null = rivals.evidence()
        log_b, error = bayes_factor(others, log_evidence(rivals))
    lower = log_b - MARGIN * error
    freedom = max(len(rivals.measurements) - rivals.rival(()).dim, 1)
    return Detection(
        alarm=bool(lower > THRESHOLD),
        log_bayes_factor=log_b,
        standard_error=error,
        lower=lower,
        threshold=THRESHOLD,
        chi_square=null.best_chi_square,
        degrees_of_freedom=freedom,
        p_value=float(chi2.sf(null.best_chi_square, freedom)),
        null_log_evidence=first,
        null_cross_check=check,
    )


def bayes_factor(
    others: list[tuple[float, float]], null: tuple[float, float]
) -> tuple[float, float]:
    """Return the log Bayes factor of an equal mixture, and its standard error.

    Args:
        others: Log evidence and its standard error, of each part of the mixture.
        null: The same of the bare model.
    """
    log_z, errors = np.array(others).T
    total = log_sum_exp(log_z)
    share = np.exp(log_z - total)
    errors = np.where(share > 0, errors, 0.0)
    variance = (share**2 * errors**2).sum() + null[1] ** 2
    log_b = total - np.log(len(others)) - null[0]
    return float(log_b), float(np.sqrt(variance))
