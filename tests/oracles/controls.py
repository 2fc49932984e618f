"""Engines that are wrong on purpose, and the right one, by the committed proposals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from tests.oracles.judging import Found
from tests.oracles.problem import Problem
from tests.oracles.reference import Answer, Weighted

#: Draws of a proposal, and of the belief that they give.
NUM_PROPOSED, NUM_DRAWS = 6_000, 4_000
#: Nats by which a wrong evidence is off: a factor of twenty, a verdict's threshold.
NATS = 3.0


def right(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return a reference sample with its evidence."""
    sample = Weighted.drawn(own, answer.proposal, NUM_PROPOSED, rng)
    theta = own.to_theta(sample.draws(NUM_DRAWS, rng))
    return Found(theta=theta, log_evidence=sample.log_evidence, error=sample.error)


def of_another_noise(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return the belief of a noise that is halved, and doubled where none is left."""
    if own.closed_form is not None:
        mean, cov, _ = own.closed_form(own.with_error(_scaled(own, 0.5)))
        return Found(theta=rng.multivariate_normal(mean, cov, NUM_DRAWS))
    for factor in (0.5, 2.0):
        other = own.with_error(_scaled(own, factor))
        sample = Weighted.drawn(other, answer.proposal, NUM_PROPOSED, rng)
        if np.isfinite(sample.log_evidence):
            break
    return Found(theta=other.to_theta(sample.draws(NUM_DRAWS, rng)))


def _scaled(own: Problem, factor: float) -> Any:
    error: Any = own.error
    return replace(error, scale=factor * error.scale)


def without_a_mode(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return the belief without its least likely region."""
    theta = right(own, answer, rng).theta
    least = min(answer.regions, key=lambda k: answer.regions[k].probability)
    return Found(theta=theta[own.region(theta) != least])


def of_another_evidence(
    own: Problem, answer: Answer, rng: np.random.Generator
) -> Found:
    """Return the right belief with an evidence that is off."""
    found = right(own, answer, rng)
    assert found.log_evidence is not None
    return replace(found, log_evidence=found.log_evidence + NATS)
