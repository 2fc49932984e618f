"""The next action: what tells models apart, and what would show an alias."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import entropy

from sbi_active import DiscreteActions
from sbi_active.criticism import Criticism, Trials, next_action
from sbi_active.criticism.next_action import beyond_range, choose_action
from sbi_active.criticism.results import ModelKey
from tests.criticism.misfit.oscillator import ACTION, EFFECTS, trials
from tests.criticism.misfit.oscillator import MODEL as OSCILLATOR
from tests.criticism.misfit.oscillator import PRIOR as RATES
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.effects import added, gain

FORWARD = DiscreteActions([1.0, 2.0, 3.0])
BOTH = DiscreteActions([-3.0, -1.0, 1.0, 3.0])
#: Forward, a slope by distance is a slope.
TILT = added("tilt", torch.abs)


def criticism(action, x, effects, actions):
    trials = Trials(action, read(x))
    return Criticism(MODEL, PRIOR, trials, effects=effects, actions=actions, seed=0)


def only(c, *names):
    """Return the tracing with these rivals alone."""
    tracing = c.trace()
    kept = {k: p for k, p in tracing.probabilities.items() if k in names}
    return replace(tracing, probabilities=kept)


def test_rivals_predict_their_posterior_predictive():
    action = torch.tensor([1.0, 2.0, 3.0, 2.0])
    c = criticism(action.tolist(), 0.7 * action, [], FORWARD)
    c.trace()
    rival = next_action.PredictedRival(c.rivals, ModelKey(), 0.5, FORWARD.values)
    x, *_ = rival.predict(torch.tensor([2.0]), 4_000, 3)
    assert x.shape == (4_000, 1)
    assert torch.equal(x, rival.predict(torch.tensor([2.0]), 4_000, 3)[0])
    assert not torch.equal(x, rival.predict(torch.tensor([2.0]), 4_000, 4)[0])
    # Least squares in one parameter; errors of the mean and of the deviation.
    fit = c.rivals.trials
    square = float((fit.action**2).sum())
    slope = float((fit.action * fit.x).sum()) / square
    sd = NOISE * (1 + 2.0**2 / square) ** 0.5
    assert float(x.mean()) == pytest.approx(2.0 * slope, abs=5 * sd / 4_000**0.5)
    assert float(x.std()) == pytest.approx(sd, rel=5 / 8_000**0.5 + 0.02)


def test_the_other_way_separates_a_tilt():
    action = [1.0, 2.0, 3.0, 2.0, 1.5]
    c = criticism(action, 0.7 * torch.tensor(action), [TILT], FORWARD)
    chosen = c.next_action()  # pushed one way
    assert frozenset({"none", "tilt"}) in chosen.inseparable
    assert float(chosen.outside[0]) < 0
    assert {*chosen.outside_separates} == {"none", "tilt"}
    assert chosen.outside_gain > 0.1
    two = only(c, "none", "tilt")
    stops = choose_action(c.rivals, two, FORWARD, outside=False)
    assert stops.action is None
    assert stops.information_gain.max() < 0.02
    assert {*stops.separates} == {"none", "tilt"}
    x = 0.7 * torch.tensor(action)
    both = criticism(action, x, [TILT], BOTH).next_action()
    assert float(both.action[0]) < 0
    assert both.inseparable == ()
    assert both.outside is None


def test_where_no_action_separates_none_is_named():
    action = [-3.0, 2.0, 3.0, -2.0]
    c = criticism(action, 0.7 * torch.tensor(action), [gain()], BOTH)
    assert frozenset({"none", "gain"}) in c.trace().equivalent
    chosen = choose_action(c.rivals, only(c, "none", "gain"), BOTH)
    assert chosen.action is None
    assert chosen.inseparable == (frozenset({"none", "gain"}),)
    assert chosen.outside is None


# Actions beyond the permitted ones


@pytest.mark.parametrize(
    ("values", "farthest", "sign"),
    [
        ([0.5, 1.0, 3.0], 4.25, 1),  # a speed has no other sign
        ([-0.5, -1.0, -3.0], 4.25, -1),
        ([-1.0, 0.0, 1.0], 2.0, 0),
    ],
)
def test_extrapolated_actions_keep_their_sign(values, farthest, sign):
    actions = DiscreteActions(values)
    found = beyond_range(actions, actions.values, limit=16)[:, 0]
    assert not bool(actions.contains(found[:, None]).any())
    assert float(found.abs().max()) == pytest.approx(farthest)
    assert bool((sign * found >= 0).all())


# The next action where every model misses


LARGER = DiscreteActions(torch.cat([ACTION[::3], torch.tensor([[3.0], [4.0]])]))


@pytest.fixture(scope="module")
def missed():
    return Criticism(
        OSCILLATOR, RATES, trials(hidden=0.6), effects=EFFECTS, actions=LARGER, seed=0
    )


@pytest.fixture(scope="module")
def chosen(missed):
    return missed.next_action()


def test_rivals_count_by_what_they_predict_and_not_by_evidence(missed, chosen):
    tracing = missed.trace()
    weights = tracing.misfit.weights
    assert chosen.separates == (*weights,)
    assert len(weights) > 2
    # The evidence alone would leave two or three.
    number = [np.exp(entropy([*p.values()])) for p in (weights, tracing.probabilities)]
    assert number[0] > 1.5 * number[1]
    assert max(weights.values()) < max(tracing.probabilities.values()) - 0.1
    assert {*weights} <= {*tracing.evidences}
    assert chosen.action is not None


def test_trials_unlike_those_at_hand_tell_most(chosen):
    assert float(chosen.action[0]) >= 3
    gain = chosen.information_gain
    assert gain[-2:].min() > gain[:-2].max()
    assert gain[-2:].max() > 0.2


def test_an_action_that_some_draws_alone_chose_is_chosen_again(
    missed, chosen, monkeypatch
):
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

    monkeypatch.setattr(next_action._Choosing, "select", unlucky)
    again = missed.next_action()
    assert calls[0] == len(LARGER.values)
    assert 0 < calls[1] < calls[0]
    assert again.action is not None
    assert again.action[0] != chosen.action[0]
