"""The choice of an estimator by what can be checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    standard_error,
)
from sbi_active.design.estimators.contrast import InfoNCEGain, LikelihoodGain, RatioGain
from sbi_active.design.estimators.entropy import EntropyGain, random_presence
from sbi_active.design.estimators.linear import LinearGain
from sbi_active.design.estimators.nested import NestedGain
from sbi_active.design.estimators.posterior import ParameterGain, PosteriorGain
from sbi_active.messages import warn

#: Name of an estimator: its class.
ESTIMATORS: dict[str, type[InformationGainEstimator]] = {
    "entropy": EntropyGain,
    "info_nce": InfoNCEGain,
    "likelihood": LikelihoodGain,
    "linear": LinearGain,
    "nested": NestedGain,
    "posterior": PosteriorGain,
    "ratio": RatioGain,
}
#: Former name of an estimator: the name of the one in its place.
FORMER = {"contrastive": "info_nce", "variational_nested": "likelihood"}
#: Numbers of x up to which nearest neighbors are trusted.
MAX_NEIGHBOR_OUTCOMES = 2
#: Parameters up to which local draws of nested Monte Carlo meet a posterior: of 40
#: uniform ones nearly all lie outside a bound, and 47 nats became 500.
MAX_NESTED_PARAMETERS = 12
#: Deviations of the noise that outcomes of more may be off a plane, which counts as
#: noise: a number loses half the square of it, nats.
MAX_BENT = 0.3


def find_estimator(
    estimator: str | InformationGainEstimator,
) -> InformationGainEstimator | None:
    """Return an estimator by name; None for "auto".

    Raises:
        ValueError: If the name is unknown; it lists the valid ones.
    """
    if isinstance(estimator, InformationGainEstimator):
        return estimator
    if estimator == "auto":
        return None
    return by_name(estimator, "estimator", ESTIMATORS, FORMER)


def by_name(
    name: str, what: str, known: Mapping[str, type], former: Mapping[str, str]
) -> Any:
    """Return an object of the class of a name.

    Args:
        name: Name that was given.
        what: Argument that takes it.
        known: Classes by name.
        former: Names by those of the last version, which still work.

    Raises:
        ValueError: If the name is unknown; it lists the valid ones.
    """
    if name in former:
        warn(
            f"SA701 {what}={name!r} goes in the next version: use "
            f'{what}="{former[name]}", or "auto"',
        )
        name = former[name]
    if name not in known:
        raise ValueError(
            f"expected {what} among 'auto', {', '.join(map(repr, known))}; got "
            f"{name!r}; choose one of these or pass an object of your own"
        )
    return known[name]()


def choose_estimator(
    model: Any, simulations: CandidateSimulations, *, num_rows: int | None = None
) -> tuple[InformationGainEstimator, list[str]]:
    """Return the first estimator whose assumptions pass their checks.

    With declared noise it is entropies if x is one number, the linear estimate of more
    than twelve parameters that x is linear in, else nested Monte Carlo.
    With replicates it is entropies for one or two numbers, else nested Monte Carlo on
    the smoothed outcomes. If checks fail, it depends on the model: the bound of a
    posterior, nested Monte Carlo on a likelihood, or InfoNCE on a ratio, which no
    normalization of it can fool, but the mean log ratio where that is near its largest
    value. Without a model outcomes that may have no measurement by luck have densities
    fitted to each candidate. Beside it, why others were not taken.

    Args:
        model: Model that was learned, or None.
        simulations: Simulations to check assumptions by.
        num_rows: Fewest simulations of a candidate that an estimate will rest on; None
            are as many as these.
    """
    num_outcomes = simulations.x[0, 0].numel()
    declared = simulations.mean is not None and simulations.noise is not None
    by_noise, notes = None, []
    if declared or simulations.replicate is not None:
        if num_outcomes <= (1 if declared else MAX_NEIGHBOR_OUTCOMES):
            by_noise = EntropyGain()
        else:
            linear = LinearGain(max_bent=MAX_BENT)
            many = declared and simulations.theta.shape[1] > MAX_NESTED_PARAMETERS
            if many and linear.suits(simulations, num_rows or len(simulations.theta)):
                return linear, []
            by_noise = NestedGain()
        problems = by_noise.problems(simulations)
        if not problems:
            return by_noise, []
        notes = [f"{type(by_noise).__name__} not used: {text}" for text in problems]
    if hasattr(model, "log_posterior"):
        return PosteriorGain(), notes
    if hasattr(model, "log_likelihood"):
        return LikelihoodGain(), notes
    if hasattr(model, "log_ratio"):
        bound, few = InfoNCEGain(), simulations.samples(slice(256))
        cautions = bound.cautions(bound(model, few, None))
        if not cautions:
            return bound, notes
        return RatioGain(), [*notes, *(f"not used: {text}" for text in cautions)]
    assert by_noise is not None
    if bool(random_presence(simulations).any()):
        return ParameterGain(range(simulations.theta.shape[1])), notes
    return by_noise, [*notes, "used all the same: there is no model"]


def disagreements(
    estimator: InformationGainEstimator,
    model: Any,
    simulations: CandidateSimulations,
    belief: Distribution | None,
    gain: Tensor,
    *,
    negligible: float = 0.3,
) -> list[str]:
    """Return cautions about an estimate, which is compared with others that apply.

    There is one short sentence for each disagreement, by the contributions (a, n):
    four standard errors beyond ``negligible`` nats.
    """
    others: list[InformationGainEstimator] = []
    num_outcomes = simulations.x[0, 0].numel()
    if isinstance(estimator, NestedGain) and num_outcomes <= MAX_NEIGHBOR_OUTCOMES:
        others.append(EntropyGain())
    # A model that is trained on demand is not trained for a note.
    at_hand = estimator.bound == "none" and getattr(model, "is_trained", True)
    if at_hand and hasattr(model, "log_posterior"):
        others.append(PosteriorGain())
    if isinstance(estimator, RatioGain):
        others.append(InfoNCEGain())
    notes = estimator.cautions(gain)
    for other in others:
        estimate = other(model, simulations, belief)
        difference = estimate - gain
        error = torch.stack([standard_error(row) for row in difference])
        mean = difference.nanmean(1)
        apart = mean.abs() > negligible + 4 * error
        for a in torch.nonzero(apart)[:, 0].tolist():
            apart[a] = not other.cautions(estimate[a : a + 1])
        if not bool(apart.any()):
            continue
        worst = int(torch.where(apart, mean.abs(), 0.0).argmax())
        side = "below" if float(mean[worst]) < 0 else "above"
        blunt = other.bound == "lower" and side == "below"
        notes.append(
            f"{type(other).__name__} is {abs(float(mean[worst])):.1f} nats {side} at "
            f"action {simulations.action[worst].tolist()}, apart at "
            f"{int(apart.sum())} of {len(apart)}"
            + (" (a lower bound: the network is blunt)" if blunt else "")
        )
    return notes
