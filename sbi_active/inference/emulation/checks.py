r"""How far a learned likelihood may be trusted, by its residuals and by fresh rows.

References:
    Hausman, Econometrica 1978 (an estimate against a safer one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, chi2, kurtosis, skew

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.declared.diagnosing import Doubt, judged
from sbi_active.inference.emulation.emulator import EmulatedLikelihood
from sbi_active.inference.emulation.pool import TrialRows
from sbi_active.inference.emulation.regression import Regression, is_misfit
from sbi_active.inference.emulation.stages import EmulationSettings, Stage
from sbi_active.inference.sampling.coordinates import near_ends


def noise_tails(
    regressions: Sequence[Regression], *, light: float = -0.3
) -> tuple[float, bool]:
    r"""Return the excess kurtosis of residuals, and whether they may have hard edges.

    A few hundred numbers tell by it (-1.2 for uniform noise, 0 for Gaussian, below
    ``light`` where it has edges) what no mixture of normal distributions follows. Its
    standard error is :math:`\sqrt{24 / n}` for Gaussian numbers (Fisher, Proc. Lond.
    Math. Soc. 1930). Regressions with misfit are left out, whose error has edges too.
    """
    residuals = [
        fit.standardized[:, fit.standardized.var(0) > 1e-6].ravel()
        for fit in regressions
        if not fit.has_misfit
    ]
    values = np.concatenate([np.zeros(0), *residuals])
    if values.size < 100:
        return 0.0, False
    margin = 3.5 * np.sqrt(24 / values.size)
    return float(kurtosis(values)), bool(kurtosis(values) < light - margin)


def shape_of_noise(
    regressions: Sequence[Regression], *, sure: float = 3.5, matters: float = 0.5
) -> float:
    r"""Return how far residuals are from normal ones, above 1 where that matters.

    It is the largest of their skewness and their excess kurtosis, of numbers that are
    normal with standard errors :math:`\sqrt{6 / n}` and :math:`\sqrt{24 / n}`, over
    what chance makes of it, or what moves a belief.

    Args:
        regressions: Regressions that take their noise for normal.
        sure: Standard errors that are no chance.
        matters: Skewness, or half of an excess kurtosis, that moves a belief: a t with
            eight degrees of freedom has a kurtosis of 1.5.
    """
    each = [0.0]
    for fit in regressions:
        values = fit.standardized[:, fit.standardized.var(0) > 1e-6]
        n = values.size
        if n >= 20:
            least = max(matters, sure * np.sqrt(6 / n))
            each.append(float(np.abs(skew(values.ravel())) / least))
            each.append(float(np.abs(kurtosis(values.ravel())) / (2 * least)))
    return max(each)


def predicted_tails(
    learned: EmulatedLikelihood, draws: Array, num_trials: int
) -> list[float]:
    """Return how often simulations at draws (n, d) lie as far out as each trial.

    And, last, as all of them, by what was learned alone.
    """
    tails = np.ones(num_trials)
    for trial, part, place in learned.of_trials():
        white, spread = part.residual(draws, place)
        tails[trial] = chi2.sf((white**2 / spread).sum(1), white.shape[1]).mean()
    return [*map(float, tails), min(1.0, num_trials * float(tails.min()))]


@dataclass(frozen=True)
class Fresh:
    """A regression's error on simulations that it was not fitted to.

    Attributes:
        tails: Tail probability of each trial and, last, of all.
        shift: Largest error of a mean, in standard deviations of the belief.
        deviation: Standard error of that.
        correlation: Correlation of their errors across trials.
        least: Squares of the observed trials at the draw that explains them best, (t,).
    """

    tails: list[float]
    shift: float
    deviation: float
    correlation: float
    least: Array


def compared_with_fresh(
    learned: EmulatedLikelihood,
    z: Array,
    numbers: Sequence[Array],
    *,
    least: float = 2e-5,
    step: float = 0.05,
    flat: float = 3.0,
) -> Fresh:
    r"""Compare a likelihood with simulations at draws of its belief.

    A tail probability is how often these miss their prediction by more than reality,

    .. math::
        P\big(D(x, \theta) \ge D(x_o, \theta)\big), \quad \theta \sim b,\;
        x \sim p(x | \theta), \quad D = |L^{-1} (x - B^\top f)|^2,

    and the shift what their mean error would move a least-squares fit by.

    Args:
        learned: Learned likelihood.
        z: Draws of the belief, shape (n, d).
        numbers: Numbers of each trial less the observed ones, each (n, q); NaN where
            there is no measurement.
        least: Tail probability that so few simulations may tell.
        step: Step of differences, in deviations of the belief.
        flat: Precision that stands for a uniform prior in [-1, 1].

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    inside = learned.region.contains(z)
    z, d, sds = z[inside], z.shape[1], z.std(0) + 1e-300
    numbers = [own[inside] for own in numbers]
    observed, simulated = np.zeros((2, len(z), len(numbers)))
    fewest = min(int(np.isfinite(own).all(1).sum()) for own in numbers)
    if fewest <= 10:
        nothing = [1.0] * (len(numbers) + 1)
        return Fresh(nothing, np.inf, 0.0, 0.0, np.zeros(len(numbers)))
    errors, axes = [], step * np.diag(sds)
    system, score = np.tile(flat * np.eye(d), (len(z), 1, 1)), np.zeros((len(z), d))
    for trial, part, place in learned.of_trials():
        predicted, spread = part.residual(z, place)
        error = part.whitened_outcomes(numbers[trial], place) - predicted
        # Errors of others stand for those without a measurement.
        lost = ~np.isfinite(error).all(1)
        error[lost] = np.resize(error[~lost], (lost.sum(), error.shape[1]))
        # A little leverage is the price of few rows; much of it is extrapolation, which
        # must not excuse a misfit.
        observed[:, trial] = (predicted**2 / np.minimum(spread, 2.0)).sum(1)
        simulated[:, trial] = (error**2 / spread).sum(1)
        errors.append(error / np.sqrt(spread))
        moved = [part.residual(z + axis, place)[0] - predicted for axis in axes]
        slope = np.stack(moved, 2) / (step * sds)
        system += np.einsum("nqj,nqk->njk", slope, slope)
        score += np.einsum("nqj,nq->nj", slope, error)
    move = np.linalg.solve(system, score[..., None])[..., 0] / sds
    each = [*zip(simulated.T, observed.T, strict=True)]
    each.append((simulated.sum(1), observed.sum(1)))
    tails = [float(_exceedance(*pair).mean().clip(least, 1.0)) for pair in each]
    worst = int(np.abs(move.mean(0)).argmax())
    return Fresh(
        tails,
        float(np.abs(move.mean(0))[worst]),
        float(move[:, worst].std() / np.sqrt(fewest)),
        _across(errors),
        observed[observed.sum(1).argmin()],
    )


def _across(errors: Sequence[Array]) -> float:
    """Return the root mean square correlation of numbers (n, q) of unlike trials."""
    if len(errors) < 2:
        return 0.0
    trial = np.repeat(np.arange(len(errors)), [e.shape[1] for e in errors])
    error = np.concatenate(errors, 1)
    varies = error.std(0) > 0
    correlation = np.atleast_2d(np.corrcoef(error[:, varies].T))
    apart = correlation[trial[varies][:, None] != trial[varies]]
    if not apart.size:
        return 0.0
    return float(max((apart**2).mean() - 1 / len(error), 0.0) ** 0.5)


def _exceedance(known: Array, value: Array) -> Array:
    r"""Return the probability that a further draw is as large, shape (m,).

    Among n known draws it is a rank. Ranks end at 1 / (n + 1), so that beyond the
    largest k the excess y over a threshold is taken for generalized Pareto,

    .. math::
        P(y) = (1 + \xi y / \bar y)^{-1 / \xi}, \qquad
        \xi = \tfrac12 (1 - \bar y^2 / s^2) \ge 1 / k,

    of their mean and variance. The least :math:`\xi` allows for a mean of k alone,
    exactly so where the tail is exponential.

    References:
        Hosking & Wallis, Technometrics 1987 (moments); Knijnenburg et al.,
        Bioinformatics 2009 (tails of permutation tests).
    """
    ordered, n = np.sort(known), len(known)
    k = max(n // 10, 5)
    threshold = ordered[-k - 1]
    excess = ordered[-k:] - threshold + 1e-12 * (1 + threshold)
    mean = excess.mean()
    shape = max(0.5 * (1 - mean**2 / (excess.var(ddof=1) + 1e-300)), 1 / k)
    beyond = (value - threshold).clip(0.0) / mean
    tail = (k + 1) / (n + 1) * (1 + shape * beyond) ** (-1 / shape)
    rank = (n - np.searchsorted(ordered, value) + 1) / (n + 1)
    return np.where(value > threshold, tail, rank)


def diagnosed(
    stages: Sequence[Stage],
    own: EmulationSettings,
    tails: list[float],
    fresh: Fresh | None,
    rows: Sequence[TrialRows],
    shape_change: float,
    off: float,
    rng: np.random.Generator,
    **known: Any,
) -> Diagnostics:
    """Return figures about the last stage, what it assumes, and warnings.

    Args:
        stages: The stages.
        own: Settings of the loop.
        tails: Tail probabilities of the trials and, last, of all together.
        fresh: What fresh simulations say of the last stage.
        rows: Simulations of each trial.
        shape_change: Nats by which noise that is not Gaussian changed the belief.
        off: Largest error of the last stage's log likelihood at some draws, nats.
        rng: Source of the errors of few simulations.
        known: Further diagnostics.
    """
    last, num, c = stages[-1], len(stages), stages[-1].learned.coordinates
    place = 0.5 * (1 + last.draws[:, c.bounded])
    edge_mass = float(near_ends(place).sum(0).max(initial=0.0))
    effective = min(stage.fit.efficiency for stage in stages)
    change = last.change if num > 1 else -1.0
    is_settled = num > 1 and change <= own.unsettled * c.dim
    doubts: dict[str, Doubt] = {
        "few_modes": (effective >= own.effective, effective),
        "settled": (is_settled or not np.isfinite(own.settled), change),
        "small_error": (last.error <= own.untrusted, last.error),
    }
    figures: dict[str, Any] = {"num_stages": num, "prior_edge_mass": edge_mass}
    details, explained = {}, last.error
    if fresh is None:
        doubts |= _of_few(last.learned, own, off)
    else:
        doubts |= _regressed(stages, own, fresh, shape_change, agreement(last, rows))
        share = [1.0] * (len(tails) - 1)
        for k, outcome in last.learned.outcomes.items():
            share[k] = float(np.exp(outcome.log_prob(last.draws)).mean())
        rare = [k for k, p in enumerate(share) if p < own.rare]
        doubts["outcomes_usual"] = not rare, min(share)
        details = {"rare": ", ".join(map(str, rare))}
        parts = last.learned.parts
        errors = [part.error(last.draws, rng, explained=True) for part in parts]
        explained = float(sum(errors))
        invalid = float(np.mean([own.share_invalid for own in rows]))
        figures |= {"share_invalid": invalid, "probability_of_outcome": share}
    return judged(
        *(doubts, details, tails, edge_mass),
        effective_sample_size=float(last.fit.effective_sample_size),
        error_nats=last.error,
        error_nats_if_explained=explained,
        figures=figures,
        **known,
    )


def _of_few(
    learned: EmulatedLikelihood, own: EmulationSettings, off: float
) -> dict[str, Doubt]:
    """Return what few rows take for granted.

    Args:
        learned: Learned likelihood.
        own: Settings of the loop.
        off: Largest error of its log likelihood at some draws, nats.
    """
    fits = [part for part in learned.parts if isinstance(part, Regression)]
    shape = shape_of_noise(fits)
    excess = max((fit.excess for fit in fits), default=0.0)
    doubts = {
        "normal_noise": (shape <= 1, shape),
        "even_noise": _evenness(fits),
        "no_misfit": (excess <= own.misfit, excess),
    }
    if len(fits) < len(learned.parts):
        doubts["likelihood_followed"] = off <= own.off, off
    return doubts


def _evenness(fits: Sequence[Regression]) -> Doubt:
    """Return whether the noise is about the same for all parameters near the belief."""
    uneven = max((fit.uneven for fit in fits), default=0.0)
    return uneven <= 1, uneven


def agreement(stage: Stage, rows: Sequence[TrialRows]) -> float:
    """Return the probability that so few simulations have outcomes as all trials had.

    Each trial's, a measurement or none, may be usual somewhere and all of them nowhere.
    Where trials do not share their simulations, 1.

    Args:
        stage: The stage that gives the probabilities.
        rows: Simulations of each trial.
    """
    z = rows[0].z
    if not all(np.array_equal(own.z, z) for own in rows):
        return 1.0
    chance, inside = np.zeros(len(z)), stage.learned.region.contains(z)
    for outcome in stage.learned.outcomes.values():
        chance += outcome.log_prob(z)
    agrees = np.all([own.agrees for own in rows], axis=0)[inside]
    return float(binom.cdf(agrees.sum(), len(agrees), np.exp(chance[inside]).mean()))


def _regressed(
    stages: Sequence[Stage],
    own: EmulationSettings,
    fresh: Fresh,
    shape_change: float,
    agreement: float,
) -> dict[str, Doubt]:
    """Return what regressions take for granted."""
    last = stages[-1].learned
    dim, excess = last.coordinates.dim, last.excess
    fits = [part for part in last.parts if isinstance(part, Regression)]
    first = stages[0].learned.parts
    rough = [part.roughness for part in first if isinstance(part, Regression)]
    roughness = max(rough, default=0.0)
    tails, has_edges = noise_tails(fits)
    known = 0.0
    if any(fit.shape is not None for fit in fits):
        # Of d parameters known to e nats, a mean is off by (2 e / d)^(1/2) deviations.
        allowed = 0.5 * dim * own.known**2
        known = shape_change / (own.unsettled * dim)
        known = max(stages[-1].error / allowed, known)
    limit = max(own.largest_shift, 3.0 * fresh.deviation)
    depends = fresh.correlation >= own.correlated and not is_misfit(excess)
    blur = max((outcome.blur for outcome in last.outcomes.values()), default=0.0)
    is_followed = blur <= own.blurred and agreement >= own.rare
    ratio = max((fit.ratio for fit in fits), default=0.0)
    return {
        "confirmed": (fresh.shift <= limit, fresh.shift),
        "gaussian_noise": (not has_edges, tails),
        "even_noise": _evenness(fits),
        "noise_known": (known <= 1, known),
        "smooth_response": (roughness <= own.rough, roughness),
        "no_misfit": (excess <= own.misfit, ratio),
        "independent_trials": (not depends, fresh.correlation),
        "outcomes_followed": (is_followed, blur),
    }
