"""Which trial puts a verdict to the test most, and what the verdict predicts of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import Any

import numpy as np
import torch
from scipy import stats
from scipy.optimize import brentq
from scipy.special import gammaln

from sbi_active.arrays import distance_from
from sbi_active.criticism.criticism import Criticism
from sbi_active.criticism.next_action import (
    following,
    permitted_candidates,
    severe_tests,
)
from sbi_active.criticism.report.contents import COVERAGE, TestedTrial
from sbi_active.criticism.report.report import Report
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    UNEXPLAINED,
    Array,
    ModelKey,
)
from sbi_active.criticism.steps.predictive import predict
from sbi_active.inference.sampling.weights import normalized
from sbi_active.seeding import derive_seed

#: Mean squared error, in sensor variances, that counts as none.
TINY = 1e-9


def choose(
    criticism: Criticism, report: Report, *, tells: float = 0.1, differs: float = 1.0
) -> Array | None:
    """Return the permitted action that puts a verdict to the test most.

    A verdict that names effects is tested where it matters most that they are there: an
    alias fits the trials so far, and errs where another action tells it from its cause.
    Where none is named, or no action tests them, rivals among the declared models are
    told apart. If nothing explains the trials, models cannot say where to look: it is
    where the residual is least known, farthest from all trials.

    Args:
        criticism: The models, fitted to the trials so far.
        report: Report with their verdict.
        tells: Information about which model is right that is worth a trial, nats.
        differs: Difference between the verdict's prediction and that without one of its
            effects that is worth a trial, in standard deviations of the former.

    Returns:
        None if no permitted action tells enough.
    """
    rivals, actions = criticism.rivals, criticism.actions
    assert actions is not None

    def told() -> Array | None:
        plan = criticism.next_action(beyond=False)
        if plan.action is None or np.max(plan.information_gain) < tells:
            return None
        return plan.action

    def test() -> Array | None:
        tests = severe_tests(rivals, report.tracing, actions, outside=False)
        severe = [t.action for t in tests if t.difference >= differs]
        return severe[0] if severe else None

    is_named = report.verdict not in (NONE, *CATCH_ALLS)
    for ask in (test, told) if is_named else (told, test):
        if (action := ask()) is not None:
            return action
    if report.verdict != UNEXPLAINED or report.trials.action_is_label:
        return None
    candidates = permitted_candidates(rivals, actions)
    distance = distance_from(rivals.trials.action, candidates)
    action = candidates[int(distance.argmax())].double().numpy()
    return action if distance.any() else None


def unless_unproven(report: Report, remaining: float) -> Report:
    """Return a report that names the effects alone that trials proved.

    Where every model misses, whatever fits the last trial best is an explanation in
    hindsight. An effect is named by what it leaves of the error of fits, and is
    withdrawn by what it leaves of the error of predictions. One that no trial tested
    helps, and is not named.

    Args:
        report: Report with the verdict on all trials, and those that tested it.
        remaining: Share of the squared error that an effect may leave
            (:class:`.Rule`).
    """
    tracing, misfit = report.tracing, report.tracing.misfit
    if misfit is None or not report.measured:
        return report
    named = tuple(n for n in misfit.named if report.left_by(n) <= remaining)
    if named == misfit.named:
        return report
    tracing = replace(
        tracing,
        verdict=str(ModelKey(named)) if named else UNEXPLAINED,
        beside=tuple(n for n in tracing.chosen if n not in named),
        misfit=replace(misfit, named=named),
        unproven=tuple(n for n in misfit.named if n not in named),
    )
    return replace(report, tracing=tracing)


def is_settled(
    report: Report, enough: int = 1, *, probability: float = 0.9, clean: float = 0.5
) -> bool:
    """Return whether a verdict is probable, and predicted what tested it.

    Args:
        report: Report with the verdict, and the trials that were run. Those since it
            was reached have to agree with its predictions, and there has to be one.
        enough: Number of these that has to be there where effects are named.
        probability: Probability of a verdict that names effects from which it may be.
        clean: Probability of "none" from which it may be: that before any trial. With
            .9 one clean simulator of eight was tested two or three times for nothing.
    """
    verdict, is_clean = report.verdict, report.verdict == NONE
    own = [*takewhile(lambda t: t.verdict == verdict, report.measured[::-1])]
    held = len(own) >= (1 if is_clean else enough) and all(trial.held for trial in own)
    return held and probability_of(report) >= (clean if is_clean else probability)


def register(
    criticism: Criticism,
    report: Report,
    action: Array,
    index: float,
    *,
    num_draws: int = 400,
) -> TestedTrial:
    """Return what the verdict predicts of a trial.

    Args:
        criticism: The models, fitted to the trials so far.
        report: Report with their verdict.
        action: Action of the trial, shape (action_dim,).
        index: Place of the trial in the order of execution.
        num_draws: Draws of a registered prediction: its 90 % limit has a
            standard error of 1 %.
    """
    rivals = criticism.rivals
    trial = following(rivals, torch.from_numpy(action)[None])
    trial.index = torch.full_like(trial.index, index)
    seed = derive_seed(rivals.seed, "registered", len(rivals.trials))
    options: dict[str, Any] = {"num_draws": num_draws, "seed": seed, "scored": False}
    predicted, key = partial(predict, rivals, trial, **options), report.tracing.key
    prediction = predicted(key=key)
    mean, sd = prediction.moments()
    distance = np.sqrt((((prediction.x - mean) / sd) ** 2).mean(1))
    limit = float(np.quantile(distance, COVERAGE))
    spread = rivals.fit(key).spread
    if spread is not None:
        mean = prediction.middle
        limit = limit_of(spread.square, len(mean)) / spread.scale
    return TestedTrial(
        index=index,
        action=action,
        verdict=report.verdict,
        mean=mean,
        sd=sd,
        position=prediction.measurements.position,
        limit=limit,
        without={n: predicted(key=key.without(n)).middle for n in key.effects},
    )


def limit_of(square: Array, most: int, num: int = 25) -> float:
    r"""Return the root of what a further mean square error stays below (.9).

    Each is as if of k independent numbers of one size, so that

    .. math::
        z / \bar z \sim F_{k, nk}, \qquad p(k) \propto \frac{1}{k}
        \frac{\Gamma(nk / 2)}{\Gamma(k / 2)^n} \prod_i \Bigl(
        \frac{z_i}{n \bar z}\Bigr)^{k / 2}, \qquad 1 \le k \le N,

    whatever their size is: along a trajectory neighbors err alike.

    Args:
        square: Mean square errors so far, shape (n,).
        most: Numbers N that the further one is the mean of.
        num: Number of k, a factor apart, that are summed over.

    References:
        Barber et al., Annals of Statistics 49 (2021), on intervals by left-out errors.
    """
    n, z = len(square), np.maximum(square, TINY)
    k = np.geomspace(1, most, num if most > 1 else 1)
    log_p = gammaln(n * k / 2) - n * gammaln(k / 2)
    log_p += k / 2 * np.log(z / z.sum()).sum()
    p = normalized(log_p)

    def off(ratio: float) -> float:
        return float(p @ stats.f.cdf(ratio, k, n * k)) - COVERAGE

    ends = stats.f.ppf(COVERAGE, k, n * k)
    ratio = brentq(off, 0.9 * ends.min(), 1.1 * ends.max())
    return float(np.sqrt(z.mean() * ratio))


def probability_of(report: Report) -> float:
    """Return the probability of a verdict; 0 if it names neither effects nor none.

    If every model misses, it is that of being there of the effect that is least sure.
    """
    tracing = report.tracing
    if tracing.instead_of or not (tracing.chosen or report.verdict == NONE):
        return 0.0
    if tracing.misfit is None:
        return tracing.probabilities.get(report.verdict, 0.0)
    own = [tracing.misfit.support[n].inclusion for n in tracing.misfit.named]
    return min(own, default=0.0)
