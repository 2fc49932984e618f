"""Logistic regressions of whether a trial gives a measurement."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from sbi_active.inference.refinement.course import StageSettings
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.regions import whole_space

NUM = 500
NONE = np.zeros((0, 2), dtype=bool)


def places(num: int = NUM, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (num, 2))


def fitted(probability, num: int = NUM) -> TrialOutcome:
    rng, z = np.random.default_rng(1), places(num)
    happened = rng.random((num, 2)) < probability(z)[:, None]
    z, agrees = np.concatenate([z, z]), happened.T.ravel()
    return TrialOutcome.fit(whole_space(2), 0, z, agrees, happened)


@pytest.mark.parametrize(
    "logit",
    [
        lambda z: 0.5 + 2 * z[:, 0],
        lambda z: -1 + 3 * z[:, 0] * z[:, 1],
        lambda z: np.full(len(z), -2.0),
    ],
    ids=["linear", "product", "constant"],
)
def test_a_smooth_chance_is_recovered(logit):
    outcome = fitted(lambda z: expit(logit(z)))
    z = places(2_000, seed=2)
    p, q = expit(logit(z)), np.exp(outcome.log_prob(z))
    loss = p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))
    # An average of half a coefficient's square error each: p / (2 n) nats.
    assert loss.mean() < 4 * len(outcome.coefficient) / (2 * 2 * NUM) + 0.002
    assert outcome.blur == 0


@pytest.mark.parametrize(
    "distance",
    [lambda z: z[:, 0] - 0.3 * z[:, 1], lambda z: 0.6 - (z**2).sum(1)],
    ids=["straight", "curved"],
)
def test_a_hard_edge_becomes_steep(distance):
    outcome = fitted(lambda z: (distance(z) > 0).astype(float))
    z = places(5_000, seed=2)
    clear = abs(distance(z)) > 0.1
    right = np.exp(outcome.log_prob(z)) > 0.5
    assert (right == (distance(z) > 0))[clear].all()
    wrong = 1 - np.exp(outcome.log_prob(z[clear & (distance(z) > 0)]))
    assert wrong.mean() < 0.02
    assert outcome.blur < 0.2 * StageSettings().blurred


def test_an_edge_it_cannot_follow_is_seen_in_its_pairs():
    outcome = fitted(lambda z: (np.floor(8 * z[:, 0]) % 2 == 0).astype(float))
    assert outcome.blur > 0.2  # a coin differs from another in half of the pairs


@pytest.mark.parametrize("agrees", [True, False])
def test_one_kind_only_follows_the_rule_of_succession(agrees: bool):
    happened = np.full(NUM, agrees)
    outcome = TrialOutcome.fit(whole_space(2), 0, places(), happened, NONE)
    expected = NUM + 1 if agrees else 1
    log_prob = outcome.log_prob(places(5, seed=1))
    assert log_prob == pytest.approx(np.log(expected / (NUM + 2)))
