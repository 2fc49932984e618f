"""What precedes the fits: samples and effects that are left out of them.

A library of many effects is screened by the linear evidence of one Jacobian.

A fit of an effect takes a dozen simulations of the trials, its column one. With the
bare model's best fit and a column of every effect the evidence of all singles and pairs
is linear algebra; effects that are in none of the best are set aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.sampling import Sampling, suggested_sampling, thinned
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.fits import JUMPING, FitSettings, best_fit, sensor_of
from sbi_active.criticism.linear.library import Library
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.noise_grid import measurement_sds
from sbi_active.criticism.steps.equivalence import MANY

#: Effects whose pairs are compared, best alone, and effects that are fitted: with 24,
#: verdicts and errors are those of 16, and take a half more of simulated trials.
PAIRED, FITTED = 30, 16


@dataclass(frozen=True)
class Screening:
    """The result of screening a library by linear evidence.

    Attributes:
        kept: Names of the effects that are worth a fit, in the library's order.
        behind: Nats by which each effect that was set aside is behind the best set,
            alone or in a pair that is better than either member, nearest first.
    """

    kept: tuple[str, ...]
    behind: dict[str, float]


def linear_models(rivals: RivalSet) -> tuple[Search, Screening | None]:
    """Return linear models of the trials, and which effects were set aside.

    Prior probabilities stay those of the whole library: what was looked at and set
    aside counts.

    Args:
        rivals: The models, with all effects.

    Returns:
        The models, without what is set aside; None for a screening where all effects
        are to be fitted.
    """
    settings = JUMPING if rivals.roughness.any() else FitSettings()
    if rivals.noise.is_by_channel:
        own = rivals.rival(ModelKey()), rivals.prior_draws, rivals.noise.typical_sd
        rivals = _sized(rivals, own[2], [best_fit(*own, settings)])
    search = Search(rivals, sensor_of(rivals), settings)
    if rivals.noise.is_by_channel:
        # What is missing may be seen in one channel alone, and no error of it.
        search.fit_singles()
        models, m = [c.model for c in search.found.values()], rivals.measurements
        best = min(models, key=lambda model: _log_sizes(model.residual, m))
        rivals = _sized(rivals, search.unit, [search.model(ModelKey()), best])
        search = Search(rivals, sensor_of(rivals), settings)
    if len(rivals.effects) <= MANY:
        return search, None
    best = _scores(search.library)
    ranked = sorted(best, key=best.__getitem__)[::-1]
    behind = {n: best[ranked[0]] - best[n] for n in ranked[FITTED:]}
    # Effects on the noise change no prediction, and no column tells of them.
    kept = tuple(n for n in rivals.effects if n not in behind)
    search.rivals = rivals.with_effects(kept)
    return search, Screening(kept, behind) if behind else None


def _sized(rivals: RivalSet, unit: Array, fits: Sequence[LinearModel]) -> RivalSet:
    """Return the models with errors of the sizes that fits leave, by channel."""
    m = rivals.measurements
    left = [np.sqrt(m.by_channel((fit.residual * unit) ** 2)) for fit in fits]
    return rivals.with_sizes(left)


def _log_sizes(residual: Array, m: Measurements) -> float:
    """Return the log size of residuals, summed over numbers, by channel."""
    rms = np.sqrt(m.by_channel(residual**2))
    return float(np.bincount(m.channel) @ np.log(np.maximum(rms, 1e-300)))


def _scores(library: Library) -> dict[str, float]:
    """Return the linear log posterior of each effect, unnormalized.

    It is that of the effect alone, or in a pair that is better than either member.
    """
    singles = {n: value for (n,), value in library.scores(library.names, 1).items()}
    ranked = sorted(singles, key=singles.__getitem__)[::-1]
    paired, best = [n for n in library.names if n in ranked[:PAIRED]], dict(singles)
    for pair, value in library.scores(paired, 2).items():
        if value > max(singles[name] for name in pair):
            best |= {name: max(best[name], value) for name in pair}
    return best


def thinned_to_need(rivals: RivalSet, trials: Trials) -> tuple[Trials, Sampling | None]:
    """Return trials without samples that the bare model's fit shows to be redundant.

    Trials are thinned only if ``measurement_sd`` declares the sensor's error: errors
    beyond it are the simulator's, and smooth.

    Args:
        rivals: The models of the trials that may be fitted.
        trials: All trials.

    Returns:
        The trials, as they are where nothing is to be left out; and what was found of
        their sampling, None if it was not looked at.
    """
    fit = rivals.trials
    own = fit.sample_times is not None
    times = fit.sample_times if own else rivals.model.sample_times
    if (
        times is None
        or measurement_sds(rivals.model.noise, rivals.measurements) is None
    ):
        return trials, None
    sensor = sensor_of(rivals)
    bare = Search(rivals, sensor).model(ModelKey())
    left = np.full(fit.x.numel(), np.nan)
    left[rivals.measurements.position] = sensor.unit * bare.residual
    sampling = suggested_sampling(fit, left.reshape(fit.x.shape), times)
    if sampling.every == 1:
        return trials, sampling
    return thinned(trials, sampling, trials.sample_times if own else times), sampling
