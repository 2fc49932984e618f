"""Whether the bare model, refitted, misses the data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED, Detection, ModelKey
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.inference.sampling.weights import log_sum_exp

#: Log Bayes factor of an alarm: under the bare model's prior predictive it is exceeded,
#: at any stopping time, with a probability of at most 1/20.
THRESHOLD = float(np.log(20.0))
#: Standard errors by which the Bayes factor must exceed the threshold.
MARGIN = 2.0
#: Standard error of the bare model's evidence that needs no other estimate, nats.
SURE = 0.3
#: Nats by which another search may end higher and count as having found the same.
NO_MORE = 1.0
#: Tail probability of the refitted chi-square that is an alarm by itself.
LEVEL = 0.01
#: Tail probability of a chi-square which is too small for the declared noise; rounds of
#: steps to the smallest one then.
TOO_SMALL, ROUNDS, MOST_STEPS = 1e-4, 2, 10
#: Tail probability of a verdict's residual below which something else is missing.
REFUTED = 0.001


def detect(rivals: RivalSet, equivalent: Sequence[frozenset[str]] = ()) -> Detection:
    r"""Return the Bayes factor of everything else against the bare model.

    .. math::
        \log B = \log \sum_k w_k Z_k - \log Z_0

    over effects with priors of unknown scale, the residual process and noise
    inflation, with the weights of :func:`alternatives`. Where the declared noise is
    Gaussian with nothing unknown, the refitted bare model's chi-square is an alarm as
    well: weak effects spend much of their Bayes factor on where among the alternatives
    they are, and the chi-square does not ask. Its false alarms, 1 in 100, are those of
    one look at the data; the Bayes factor's bound holds at any stopping time.

    Before an alarm, the bare model is searched again from where other models have its
    parameters, since a mode that the first search missed would be a false alarm. Where
    the two disagree, derivatives mean little or the evidence has a large error, it is
    sampled again from what the second found.

    Args:
        rivals: The models.
        equivalent: Groups that no permitted action separates, found without the data.

    References:
        Ville, Etude critique de la notion de collectif (1939), for any stopping time.
    """
    null = rivals.fit().evidence
    # First what is likeliest: beside it, a hopeless effect is soon dismissed.
    weights = alternatives([e.name for e in rivals.library], equivalent)
    promising = [*rivals.effects]
    if not rivals.nuisances:
        promising = sorted(
            rivals.effects, key=lambda n: promise(rivals, ModelKey.of(n)), reverse=True
        )
    found = {
        name: log_evidence(rivals, ModelKey.of(name))
        for name in dict.fromkeys([UNEXPLAINED, SCATTER, *promising])
    }
    others = [
        (found[name][0] + float(np.log(w)), found[name][1])
        for name, w in weights.items()
        if name in found  # what was screened out has no evidence to speak of
    ]
    before = null.log_evidence
    log_b, error = bayes_factor(others, log_evidence(rivals))
    freedom = max(len(rivals.measurements) - num_determined(rivals), 1.0)
    level = LEVEL if rivals.has_known_noise else 0.0
    p_value, check = float(chi2.sf(null.best_chi_square, freedom)), None
    is_alarm = log_b - MARGIN * error > THRESHOLD or p_value < level
    sure = rivals.is_smooth and null.standard_error < SURE
    if is_alarm and not (sure and is_found_again(rivals)):
        check = rivals.fit_again().log_evidence
        null = rivals.fit().evidence
        log_b, error = bayes_factor(others, log_evidence(rivals))
        p_value = float(chi2.sf(null.best_chi_square, freedom))
    lower = log_b - MARGIN * error
    least, lower_p = _least_chi_square(rivals)
    return Detection(
        log_bayes_factor=log_b,
        standard_error=error,
        lower=lower,
        threshold=THRESHOLD,
        chi_square=null.best_chi_square,
        degrees_of_freedom=freedom,
        p_value=p_value,
        level=level,
        null_log_evidence=before,
        null_cross_check=check,
        least_chi_square=least,
        lower_p_value=lower_p,
    )


def promise(rivals: RivalSet, key: ModelKey) -> float:
    """Return the largest log posterior density that a search finds of a model.

    It costs a part of a fit, which then continues from there.

    Args:
        rivals: Set of all models.
        key: Key of the model.
    """
    if key in rivals.fits:
        return np.inf
    rival = rivals.rival(key)
    if key not in rivals.found:
        rivals.found[key] = rivals.search(key)
    at = rivals.found[key].modes
    return float((rival.log_prior(at) + rival.log_likelihood(at)).max())


def is_found_again(rivals: RivalSet) -> bool:
    """Return whether another search ends where the bare model was sampled."""
    fit = rivals.fit()
    own, other = (
        float((fit.rival.log_prior(u) + fit.rival.log_likelihood(u)).max())
        for u in (fit.sample.u, rivals.search_again().modes)
    )
    return other < own + NO_MORE


def _least_chi_square(rivals: RivalSet) -> tuple[float, float]:
    """Return the smallest chi-square of the bare model, and how probable one is.

    Errors of t noise are taken as Gaussian of its core, which are no larger.
    """
    noise, own = rivals.noise, rivals.model.noise
    rival, sample = rivals.fit().rival, rivals.fit().sample
    declared = own is not None and own.posterior is None and len(noise.scales) == 1
    spare = len(rivals.measurements) - rival.dim
    if not declared or rivals.roughness.any() or spare < 1:
        return np.nan, 1.0
    residual = rival.residual(sample.u, penalized=False)[0]
    k = int(np.argmin(((residual / noise.typical_sd) ** 2).sum(1)))
    white = noise.whitener(residual[k])
    least = float((white(residual[k]) ** 2).sum())
    df = noise.cells[0].df
    core = df / (df - 2) if np.isfinite(df) else 1.0
    p = float(chi2.cdf(core * least, spare))
    if not p < TOO_SMALL:
        return least, p
    # Where the noise is far too large the draws lie far apart by the trials' own error.
    best = sample.u[[k]]
    for _ in range(ROUNDS):
        unit = np.sqrt(least / spare)
        best, _ = descend(
            rival, best, lambda r, unit=unit: white(r) / unit, rivals.step, MOST_STEPS
        )
        rest = white(rival.residual(best, penalized=False)[0])
        least = min(least, float((rest**2).sum()))
    return least, float(chi2.cdf(core * least, spare))


def num_determined(rivals: RivalSet) -> float:
    r"""Return the number of the bare model's parameters that the data determine.

    .. math::
        \gamma = \sum_i (1 - \lambda_i)_+

    with the eigenvalues of the posterior covariance in units of the prior's. What the
    data leave as it was takes up no residual.

    References:
        MacKay, Neural Computation 4, 1992, 415-447 (the evidence framework).
    """
    sample = rivals.fit().sample
    weights = sample.weight
    center = sample.u - weights @ sample.u
    variances = np.linalg.eigvalsh((weights[:, None] * center).T @ center)
    return float(np.clip(1 - variances, 0.0, None).sum())


def alternatives(
    effects: Sequence[str], equivalent: Sequence[frozenset[str]]
) -> dict[str, float]:
    """Return the weights of the alternatives to the bare model, which sum to one.

    The residual process, noise inflation and each effect have equal weights; effects
    that nothing separates count as one, and effects that nothing separates from the
    bare model do not count.

    Args:
        effects: Names of the effects.
        equivalent: Groups that nothing separates, with "none" for the bare model.

    Example:
        >>> groups = [frozenset({"none", "gain"}), frozenset({"bias", "offset"})]
        >>> alternatives(["gain", "bias", "offset"], groups)["bias"]  # 1 / 2 of 1 / 3
        0.16666666666666666
    """
    shares = {UNEXPLAINED: 1.0, SCATTER: 1.0}
    for name in effects:
        group = next((g for g in equivalent if name in g), frozenset({name}))
        if NONE not in group:
            shares[name] = 1 / len(group & {*effects})
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items()}


def bayes_factor(
    others: list[tuple[float, float]], null: tuple[float, float]
) -> tuple[float, float]:
    """Return the log Bayes factor of a mixture, and its standard error.

    Args:
        others: Log of weight times evidence and its error, of each part.
        null: Log evidence of the bare model and its error.
    """
    log_z, errors = np.array(others).T
    total = log_sum_exp(log_z)
    share = np.exp(log_z - total)
    errors = np.where(share > 0, errors, 0.0)
    variance = (share**2 * errors**2).sum() + null[1] ** 2
    log_b = total - null[0]
    return float(log_b), float(np.sqrt(variance))
