r"""What precedes the fits: samples and effects that are left out of them.

Errors of a simulator are smooth, and at a high sampling rate each sample repeats the
error of the one before. An autocorrelated error takes up some of that, and its
innovations

.. math::
    e_k = \frac{r_k - \rho_k r_{k-1}}{\sqrt{1 - \rho_k^2}}, \qquad
    \rho_k = e^{-\Delta t_k / \tau},

with the :math:`\tau` of the largest likelihood, are independent where it takes up all.
Where neighboring innovations are correlated, every Bayes factor counts the same motion
several times.

A fit of an effect takes a dozen simulations of the trials, its column one. With the
bare model's best fit and a column of every effect the evidence of all singles and pairs
is linear algebra; of a library of many effects, those in none of the best are set
aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.fits import JUMPING, FitSettings, best_fit, sensor_of
from sbi_active.criticism.linear.library import Library
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import measurement_sds
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.equivalence import MANY


@dataclass(frozen=True, kw_only=True)
class NeedSettings:
    """Settings of the sampling that trials need.

    Attributes:
        independent: Correlation of neighboring innovations that counts as none.
        significant: Multiple of its standard error that counts as none.
        fewest: Samples of the median trial that are left, at least.
        num_times: Number of correlation times that are tried.
        shortest: The shortest of them, in steps.
        longest: The longest of them, in spans of the recording.
    """

    independent: float = 0.2
    significant: float = 3.0
    fewest: int = 8
    num_times: int = 40
    shortest: float = 0.2
    longest: float = 2.0


NEED = NeedSettings()


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """The sampling of trials, and the sampling that they need.

    Attributes:
        step: Median time between samples, s.
        every: Interval of the samples to keep: every 1st, 2nd,
        before: Largest correlation of neighboring innovations at the higher rates that
            were looked at, of all samples where they are all kept.
        after: Largest correlation of neighboring innovations of the samples that are
            kept.
    """

    step: float
    every: int
    before: float
    after: float

    @property
    def suggested_step(self) -> float:
        """Time between the samples that are kept, s."""
        return self.every * self.step


def suggested_sampling(trials: Trials, residuals: Any, times: Any = None) -> Sampling:
    """Return the sampling of trials, and the sampling that they need.

    The needed rate is the first one, from high to low, at which neighboring innovations
    are correlated by no more than .2, or three standard errors, after a rate at which
    they are: at a very high rate the sensor's error hides the simulator's. All samples
    are kept if no rate has correlated innovations. At least 8 samples of a trial are
    left.

    Args:
        trials: Trials with sample times.
        residuals: Residuals that a fitted model leaves, of the shape of x (n, k, ...),
            NaN where nothing was measured.
        times: Sample times, shape (k,) or (n, k), where the trials have none.

    References:
        Ljung, System Identification, 2nd edition, 1999, section 16.6: residuals that
        are not white.

    Example:
        >>> import torch
        >>> times = torch.linspace(0, 10, 400)
        >>> x = torch.stack([(times + shift).sin() for shift in (0.0, 1.0, 2.0)])
        >>> trials = Trials(torch.arange(3.0), x, sample_times=times)
        >>> suggested_sampling(trials, x).every > 10
        True
    """
    r = np.asarray(residuals, dtype=float)
    n, k = r.shape[:2]
    r = r.reshape(n, k, -1)
    size = np.sqrt(np.nanmean(r**2, axis=(0, 1)))
    series = (r / np.where(size > 0, size, 1.0)).transpose(0, 2, 1).reshape(-1, k)
    stamps = np.repeat(_stamps(trials, times), r.shape[2], axis=0)
    # Each trial and channel by its own samples, whatever others have between them.
    order = np.argsort(~np.isfinite(series), axis=1, kind="stable")
    series = np.take_along_axis(series, order, 1)
    stamps = np.take_along_axis(stamps, order, 1)
    stamps = np.where(np.isfinite(series), stamps, np.nan)
    gaps = np.diff(stamps, axis=1)
    step = float(np.nanmedian(gaps)) if np.isfinite(gaps).any() else 1.0
    count = int(np.median(np.isfinite(series).sum(1)))
    found: list[float] = []
    is_hidden = True  # and may yet show
    for every in range(1, max(count // NEED.fewest, 1) + 1):
        correlation, num = _innovations(series, stamps, every)
        found.append(correlation)
        if not _independent(correlation, num):
            is_hidden = False
        elif not is_hidden:
            break
    every = 1 if is_hidden else len(found)
    return Sampling(
        step=step,
        every=every,
        before=found[0] if every == 1 else max(found[:-1]),
        after=found[every - 1],
    )


def thinned(trials: Trials, sampling: Sampling, times: Any = None) -> Trials:
    """Return trials of which only samples as far apart as suggested count as measured.

    The others are masked, in each trial and channel by itself: times and other inputs
    of the simulator stay as they are. The first samples, often the start that the
    simulator is given, are masked too; a shorter trial keeps its last one.

    Args:
        trials: Trials with x of shape (n, k, ...).
        sampling: Sampling that was found.
        times: Sample times, as in :func:`suggested_sampling`.
    """
    found = trials.select(slice(None))
    n, k = trials.x.shape[:2]
    stamps = _stamps(trials, times)
    x = found.x.reshape(n, k, -1)
    for i in range(n):
        for channel in x[i].T:
            place = np.flatnonzero(channel.isfinite().numpy())
            if not len(place):
                continue
            at, apart = stamps[i, place], sampling.suggested_step - 0.5 * sampling.step
            kept, last = [], at[0] - sampling.step
            while (following := np.searchsorted(at, last + apart)) < len(at):
                kept.append(following)
                last = at[following]
            keep = place[kept or [-1]]
            channel[np.setdiff1d(np.arange(k), keep)] = float("nan")
    return found


def _stamps(trials: Trials, times: Any) -> Array:
    """Return sample times, shape (n, k)."""
    stamps = trials.sample_times if times is None else times
    return np.broadcast_to(np.asarray(stamps, dtype=float), trials.x.shape[:2])


def _independent(correlation: float, num: int) -> bool:
    # Differences of independent errors are correlated as well, with the other sign.
    return correlation <= max(NEED.independent, NEED.significant / np.sqrt(max(num, 1)))


def _innovations(series: Array, stamps: Array, every: int) -> tuple[float, int]:
    """Return the correlation of neighboring innovations, and how many pairs there are.

    Args:
        series: Residuals, one a trial and channel, shape (s, k), NaN where missing.
        stamps: Times of the samples, of the same shape.
        every: Interval of the samples that are kept: every 1st, 2nd, ...
    """
    r, t = series[:, every - 1 :: every], stamps[:, every - 1 :: every]
    gaps = np.diff(t, axis=1)
    if gaps.shape[1] < 2 or not np.isfinite(gaps).any():
        return 0.0, 0
    step, span = np.nanmedian(gaps), np.nanmax(t) - np.nanmin(t)
    best, chosen = -np.inf, np.zeros((len(r), 0))
    for tau in np.geomspace(
        NEED.shortest * step, max(NEED.longest * span, step), NEED.num_times
    ):
        variance = -np.expm1(-2 * gaps / tau)
        e = (r[:, 1:] - np.exp(-gaps / tau) * r[:, :-1]) / np.sqrt(variance)
        seen = np.isfinite(e)
        first = r[:, :1][np.isfinite(r[:, :1])]
        num = seen.sum() + len(first)
        square = (e[seen] ** 2).sum() + (first**2).sum()
        log_p = -0.5 * num * np.log(max(square / num, 1e-300))
        log_p -= 0.5 * np.log(variance[seen]).sum()
        if log_p > best:
            best, chosen = log_p, e
    one, two = chosen[:, :-1], chosen[:, 1:]
    both = np.isfinite(one) & np.isfinite(two)
    power = float((chosen[np.isfinite(chosen)] ** 2).mean()) if both.any() else 0.0
    if power == 0:
        return 0.0, 0
    return float((one[both] * two[both]).mean() / power), int(both.sum())


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
