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

import numpy as np
import torch

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.fits import JUMPING, FitSettings, best_fits
from sbi_active.criticism.linear.library import Library
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import series_of
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell, measurement_sds
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


def suggested_sampling(m: Measurements, residual: Array) -> Sampling:
    """Return the sampling of trials, and the sampling that they need.

    The needed rate is the first one, from high to low, at which neighboring innovations
    are correlated by no more than .2, or three standard errors, after a rate at which
    they are: at a very high rate the sensor's error hides the simulator's. All samples
    are kept if no rate has correlated innovations. At least 8 samples of a trial are
    left.

    Args:
        m: Measurements with a time axis.
        residual: Residuals that a fitted model leaves, shape (N,).

    References:
        Ljung, System Identification, 2nd edition, 1999, section 16.6: residuals that
        are not white.

    Example:
        >>> import torch
        >>> times = torch.linspace(0, 10, 400)
        >>> x = torch.stack([(times + shift).sin() for shift in (0.0, 1.0, 2.0)])
        >>> m = Measurements.of(Trials(torch.arange(3.0), x, sample_times=times))
        >>> suggested_sampling(m, m.x).every > 10
        True
    """
    size = np.sqrt(m.by_channel(residual**2))
    r = residual / np.where(size > 0, size, 1.0)[m.channel]
    # Each trial and channel by its own samples, whatever others have between them.
    series = series_of(m, 0 * m.trial)
    place = np.concatenate([1 + np.arange(len(at)) for at in series])
    count = int(np.median([len(at) for at in series]))
    found: list[float] = []
    is_hidden = True  # and may yet show
    for every in range(1, max(count // NEED.fewest, 1) + 1):
        kept = place % every == 0
        correlation, num = _innovations(m.part(kept), r[kept])
        found.append(correlation)
        if not _independent(correlation, num):
            is_hidden = False
        elif not is_hidden:
            break
    every = 1 if is_hidden else len(found)
    return Sampling(
        step=m.step,
        every=every,
        before=found[0] if every == 1 else max(found[:-1]),
        after=found[every - 1],
    )


def thinned(
    trials: Trials, sampling: Sampling, model_times: Array | None = None
) -> Trials:
    """Return trials of which only samples as far apart as suggested count as measured.

    The others are masked, in each trial and channel by itself: times and other inputs
    of the simulator stay as they are. The first samples, often the start that the
    simulator is given, are masked too; a shorter trial keeps its last one.

    Args:
        trials: Trials with x of shape (n, k, ...).
        sampling: Sampling that was found.
        model_times: The simulator's sample times, shape (k,), where the trials have
            none.
    """
    found, m = trials.select(slice(None)), Measurements.of(trials, model_times)
    masked, apart = m.time < np.inf, sampling.suggested_step - 0.5 * sampling.step
    for at in series_of(m, 0 * m.trial):
        kept, stamps = [], m.time[at]
        last = stamps[0] - sampling.step
        while (following := np.searchsorted(stamps, last + apart)) < len(at):
            kept.append(following)
            last = stamps[following]
        masked[at[kept or [-1]]] = False
    found.x.view(-1)[torch.from_numpy(m.position[masked])] = torch.nan
    return found


def _independent(correlation: float, num: int) -> bool:
    # Differences of independent errors are correlated as well, with the other sign.
    return correlation <= max(NEED.independent, NEED.significant / np.sqrt(max(num, 1)))


def _innovations(m: Measurements, r: Array) -> tuple[float, int]:
    """Return the correlation of neighboring innovations, and how many pairs there are.

    Args:
        m: Measurements that are kept.
        r: Their residuals, shape (N,).
    """
    follows = np.isfinite(m.gap)
    pairs = follows[1:] & follows[:-1]
    if not pairs.any():
        return 0.0, 0
    ends = NEED.shortest * m.step, max(NEED.longest * m.span, m.step)
    best, e = -np.inf, r
    for tau in np.geomspace(*ends, NEED.num_times):
        cell = NoiseCell.of(m, sd=np.ones(len(m)), correlation_time=tau)
        new = cell.whiten(r)
        log_p = -0.5 * len(r) * np.log(max((new**2).mean(), 1e-300)) - cell.log_scale
        if log_p > best:
            best, e = log_p, new
    power = float((e[follows] ** 2).mean())
    if power == 0:
        return 0.0, 0
    return float((e[:-1] * e[1:])[pairs].mean() / power), int(pairs.sum())


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
        rivals = _sized(rivals, own[2], best_fits(*own, settings)[:1])
    search = Search(rivals, settings)
    if rivals.noise.is_by_channel:
        # What is missing may be seen in one channel alone, and no error of it.
        search.fit_singles()
        models, m = [c.model for c in search.found.values()], rivals.measurements
        best = min(models, key=lambda model: _log_sizes(model.residual, m))
        rivals = _sized(rivals, search.unit, [search.model(ModelKey()), best])
        search = Search(rivals, settings)
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
    m, model_times = rivals.measurements, rivals.model.sample_times
    if rivals.trials.sample_times is None and model_times is None:
        return trials, None
    if measurement_sds(rivals.model.noise, m) is None:
        return trials, None
    search = Search(rivals)
    left = search.unit * search.model(ModelKey()).residual
    sampling = suggested_sampling(m, left)
    if sampling.every == 1:
        return trials, sampling
    times = None if model_times is None else model_times.double().numpy()
    return thinned(trials, sampling, times), sampling
