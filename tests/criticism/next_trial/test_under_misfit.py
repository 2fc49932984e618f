"""The next action where every model misses."""

import numpy as np
import pytest
import torch
from scipy.stats import entropy

from sbi_active import DiscreteActions
from sbi_active.criticism import Criticism
from tests.criticism.misfit.oscillator import ACTION, EFFECTS, MODEL, PRIOR, trials

LARGER = DiscreteActions(torch.cat([ACTION, torch.tensor([[3.0], [4.0]])]))


@pytest.fixture(scope="module")
def missed():
    return Criticism(
        MODEL, PRIOR, trials(hidden=0.6), effects=EFFECTS, actions=LARGER, seed=0
    )


def test_rivals_count_by_what_they_predict_and_not_by_evidence(missed):
    tracing, chosen = missed.trace(), missed.next_action()
    weights = tracing.misfit.weights
    assert chosen.separates == (*weights,)
    assert len(weights) > 2
    # The evidence alone would leave two or three.
    number = [np.exp(entropy([*p.values()])) for p in (weights, tracing.probabilities)]
    assert number[0] > 1.5 * number[1]
    assert max(weights.values()) < max(tracing.probabilities.values()) - 0.1
    assert {*weights} <= {*tracing.evidences}
    assert chosen.action is not None


def test_trials_unlike_those_at_hand_tell_most(missed):
    chosen = missed.next_action()
    assert float(chosen.action[0]) >= 3
    gain = chosen.information_gain
    assert gain[-2:].min() > gain[:-2].max()
    assert gain[-2:].max() > 0.2
