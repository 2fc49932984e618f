"""Designs from simulations at hand, such as those that the model was trained on."""

from __future__ import annotations

from typing import Any

import torch
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.design.elimination import Race, choose
from sbi_active.design.estimators.automatic import choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.limits import DesignLimits
from sbi_active.simulation import Outcome, Simulations
from sbi_active.threads import single_thread

IN_SAMPLE = (
    "estimated on the given simulations: too high where the model was trained on them, "
    "and more so for actions that it overfits"
)


def design_given(
    given: Simulations,
    estimator: InformationGainEstimator | None,
    model: Any,
    belief: Distribution | None,
    limits: DesignLimits,
    seed: int,
    *,
    fewest: int = 16,
) -> Design:
    """Return a design without further simulations: half of the rows choose.

    The others report. Each action of a list is estimated on its own rows.

    Args:
        given: Simulations at hand.
        estimator: Estimator of the information; None is chosen by what the model says.
        model: Model that the estimator needs.
        belief: Distribution of the parameters.
        limits: Limits and costs of the actions.
        seed: Seed of the draws behind probabilities.
        fewest: Number of rows that a candidate needs.

    Raises:
        TypeError: If the rows are no simulations, or the actions no list.
        ValueError: If there is no model, or no candidate has rows enough.
    """
    action, notes = limits.listed()
    if action is None or not isinstance(given, Simulations):
        raise TypeError(
            "expected a list of actions and Simulations(theta, action, x) at these for "
            f"simulations=; got {limits.actions!r} and {given!r:.80}; leave it out, or "
            "list the actions"
        )
    if model is None:
        raise ValueError(
            "expected a model with simulations=; got None; pass the trained model, or "
            "leave out simulations="
        )
    near = torch.isclose(given.action[:, None], action, rtol=1e-5, atol=1e-7).all(2)
    num = near.sum(0)
    if int(num.max()) < fewest:
        raise ValueError(
            f"expected simulations with at least {fewest} rows of a candidate; got "
            "fewer of every one; pass rows at the actions of the list"
        )
    near &= num >= fewest
    known = near & (given.status != Outcome.MISSING)[:, None]
    share = (known & (given.status == Outcome.OK)[:, None]).sum(0) / known.sum(0)
    x = given.x.expand(len(action), *given.x.shape)
    halves = [
        CandidateSimulations(given.theta, action, x, missing=~(known & own).T)
        for own in (near.cumsum(0) % 2 == 1, near.cumsum(0) % 2 == 0)
    ]
    estimator = estimator or choose_estimator(model, halves[0], belief)[0]
    with single_thread():
        gains = torch.stack([estimator(model, half, belief) for half in halves])
    # No row is of two candidates: each has its own in front.
    gains = gains.gather(2, gains.isnan().int().argsort(dim=2, stable=True))
    eligible = limits.reached_by(share)
    index = torch.nonzero(eligible)[:, 0]
    race = Race(gains[0, index] / limits.cost(action)[index, None], seed)
    said = [IN_SAMPLE, *limits.excluded_note(eligible | (num < fewest))]
    if few := int((num < fewest).sum()):
        said.append(f"{few} candidates with fewer than {fewest} rows excluded")
    return choose(
        limits,
        action=action,
        halves=gains,
        eligible=eligible,
        leader=int(index[race.leader]),
        seed=seed,
        probability_valid=share.double(),
        estimator=type(estimator).__name__,
        bound="none",  # the model may have seen the rows
        num_simulations=0,
        num_samples=near.sum(0),
        stopped="simulations given",
        notes=(*said, *notes),
    )
