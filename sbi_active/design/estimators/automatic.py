"""The choice of an estimator by what can be checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.estimators.contrast import (
    InfoNCEGain,
    LikelihoodGain,
    PosteriorGain,
    RatioGain,
)
from sbi_active.design.estimators.entropy import EntropyGain, random_presence
from sbi_active.design.estimators.linear import LinearGain
from sbi_active.design.estimators.nested import NestedGain
from sbi_active.design.estimators.posterior import ParameterGain
from sbi_active.expected import require
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
#: Former name of an estimator or a search: the name of the one in its place.
FORMER = {
    "bayesopt": "gradient",
    "contrastive": "info_nce",
    "variational_nested": "likelihood",
}
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
    return by_name(estimator, "estimator", InformationGainEstimator, ESTIMATORS)


def by_name(given: Any, what: str, kind: type, known: Mapping[str, type]) -> Any:
    """Return an object of the class of a name, or of a former one; None for "auto".

    Args:
        given: Name, or an object.
        what: Argument that takes it.
        kind: Class of such objects.
        known: Classes by name.

    Raises:
        ValueError: If the name is unknown; it lists the valid ones.
    """
    if given == "auto" or isinstance(given, kind):
        return None if given == "auto" else given
    if FORMER.get(given) in known:
        now = FORMER[given]
        warn(f'SA701 {what}={given!r} goes in the next version: use {what}="{now}"')
        given = now
    names = ", ".join(map(repr, ("auto", *known)))
    advice = "choose one of these or pass an object of your own"
    require(given in known, f"{what} among {names}", repr(given), advice)
    return known[given]()


def choose_estimator(
    model: Any,
    simulations: CandidateSimulations,
    belief: Distribution | None,
    num_rows: int | None = None,
) -> tuple[InformationGainEstimator, list[str]]:
    """Return the first estimator whose assumptions pass their checks.

    With declared noise it is entropies if x is one number that takes no few values, the
    linear estimate of more
    than twelve parameters that x is linear in, else nested Monte Carlo.
    With replicates it is entropies for one or two numbers, else nested Monte Carlo on
    the smoothed outcomes. If checks fail, it depends on the model: the bound of a
    posterior, nested Monte Carlo on a likelihood, or InfoNCE on a ratio, which no
    normalization of it can fool, but the mean log ratio where that is near its largest
    value. Without a model outcomes that may have no measurement by luck have densities
    fitted to each candidate. Also returns why others were not used.

    Args:
        model: Model that was learned, or None.
        simulations: Simulations to check assumptions by.
        belief: Distribution of the parameters.
        num_rows: Fewest simulations of a candidate that an estimate will rest on; None
            are as many as these.
    """
    num_outcomes = simulations.x[0, 0].numel()
    declared = simulations.mean is not None and simulations.noise is not None
    by_noise: dict[InformationGainEstimator, list[str]] = {}
    if declared or simulations.replicate is not None:
        linear = LinearGain(max_bent=MAX_BENT)
        num_rows = num_rows or len(simulations.theta)
        many = declared and simulations.theta.shape[1] > MAX_NESTED_PARAMETERS
        if num_outcomes <= (1 if declared else MAX_NEIGHBOR_OUTCOMES):
            by_noise[EntropyGain()] = []
        elif many and linear.suits(simulations, num_rows):
            return linear, []
        by_noise[NestedGain()] = []
    notes: list[str] = []
    for each, problems in by_noise.items():
        problems += each.problems(simulations)
        if not problems:
            return each, notes
        new = [text for text in problems if not any(text in note for note in notes)]
        notes += [f"{type(each).__name__} not used: {text}" for text in new]
    for kind in (PosteriorGain, LikelihoodGain):
        if hasattr(model, kind.functions[0]):
            return kind(), notes
    if hasattr(model, "log_ratio"):
        bound, few = InfoNCEGain(), simulations.samples(slice(256))
        cautions = bound.cautions(bound(model, few, belief))
        if not cautions:
            return bound, notes
        return RatioGain(), [*notes, *(f"not used: {text}" for text in cautions)]
    if bool(random_presence(simulations).any()):
        return ParameterGain(), notes
    least = min(by_noise, key=lambda each: len(by_noise[each]))
    return least, [*notes, "used all the same: there is no model"]
