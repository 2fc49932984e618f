"""The next action where every model misses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import entropy

from sbi_active import DiscreteActions
from sbi_active.criticism import Criticism
from sbi_active.criticism.next_trial import next_action
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


def test_an_action_that_some_draws_alone_chose_is_chosen_again(missed, monkeypatch):
    """Its report is of other draws, and there it may tell nothing."""
    select, calls = next_action._Choosing.select, []

    def unlucky(self, names, p, candidates, **options):
        design = select(self, names, p, candidates, **options)
        calls.append(len(candidates))
        if options:
            return design
        gain = design.expected_information_gain.clone()
        gain[design.index] = 0.0
        return replace(design, expected_information_gain=gain)

    first = missed.next_action()
    monkeypatch.setattr(next_action._Choosing, "select", unlucky)
    chosen = missed.next_action()
    assert calls[0] == len(LARGER.values)
    assert 0 < calls[1] < calls[0]
    assert chosen.action is not None
    assert chosen.action[0] != first.action[0]
