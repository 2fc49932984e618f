"""The next action: what tells models apart, and what would show an alias."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import entropy

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Trials, generic_effects, next_action
from sbi_active.criticism.next_action import (
    beyond_range,
    choose_action,
    following,
    severe_tests,
)
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.predictive import predict
from tests.criticism import slope_world
from tests.criticism.misfit.oscillator import ACTION, EFFECTS, trials
from tests.criticism.misfit.oscillator import MODEL as OSCILLATOR
from tests.criticism.misfit.oscillator import PRIOR as RATES
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.effects import BIAS, added, gain, with_error

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


#: Actions, the farthest beyond them, and their sign.
EXTRAPOLATED = [
    ([0.5, 1.0, 3.0], 4.25, 1),  # a speed has no other sign
    ([-0.5, -1.0, -3.0], 4.25, -1),
    ([-1.0, 0.0, 1.0], 2.0, 0),
]


@pytest.mark.parametrize(("values", "farthest", "sign"), EXTRAPOLATED)
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


# A confident alias: what the report says, and the actions that would show it


FINE = 0.01
ANGLES = torch.linspace(0.2, 1.2, 11).double()
ANGLES = DiscreteActions(ANGLES, names=["angle"], units=["rad"])
STEP, SAMPLES, EVERY = 0.08, 8, 3


def pendulum(theta, action, magnet=0.0):
    """Angles of a pendulum let go at the action, midpoint rule."""
    length, damping = theta.T
    q, v = action[:, 0], torch.zeros(len(action)).to(action)

    def force(q, v):
        return -9.81 / length * torch.sin(q) - damping * v - magnet * torch.sin(2 * q)

    x = []
    for _ in range(SAMPLES * EVERY):
        half = q + STEP / 2 * v, v + STEP / 2 * force(q, v)
        q, v = q + STEP * half[1], v + STEP * force(*half)
        x.append(q)
    return torch.stack(x[EVERY - 1 :: EVERY], 1)


def truth(action):
    """The pendulum with the magnet that its simulator lacks."""
    theta = torch.tensor([[1.0, 0.2]]).double().expand(len(action), 2)
    return pendulum(theta, action, magnet=1.0)


@pytest.fixture(scope="module")
def aliased():
    names = ["length", "damping"]
    model = SimulatorModel(pendulum, noise=FINE, parameter_names=names)
    prior = BoxUniform(torch.tensor([0.3, 0.0]), torch.tensor([2.0, 1.0]))
    generator = torch.Generator().manual_seed(1)
    action = ANGLES.values[torch.randperm(11, generator=generator)[:8]]
    x = with_error(truth(action), FINE, generator)
    gains = [e for e in generic_effects(model, ANGLES) if e.name.endswith(" gain")]
    return Criticism(model, prior, Trials(action, x), effects=gains, actions=ANGLES)


def test_a_confident_alias_is_told_as_what_it_is(aliased):
    report = aliased.report(evaluate=False)
    assert report.verdict == "action gain + sensor gain"
    assert report.probabilities[report.verdict] > 0.84  # the most that two can have
    length = report.parameters.set_index("parameter").loc["length"]
    assert abs(length["after"] - 1.0) > 5 * length["after_sd"]  # confident, and wrong
    tested = [float(t.action[0]) for t in report.severe_tests]
    assert tested == pytest.approx([1.1, 1.7])  # 1.2 was tried, 1.7 is not permitted


def test_the_verdict_fails_most_where_it_is_put_to_the_test(aliased):
    inside, beyond = severe_tests(aliased.rivals, aliased.trace(), ANGLES)
    assert (inside.is_permitted, beyond.is_permitted) == (True, False)
    others, key = beyond_range(ANGLES, ANGLES.values, limit=16), aliased.trace().key
    for found, candidates in ((inside, ANGLES.values), (beyond, others)):
        trials = following(aliased.rivals, candidates)
        mean, _ = predict(aliased.rivals, trials, key=key, scored=False).moments()
        off = truth(candidates.double()).numpy() - mean.reshape(len(candidates), -1)
        missed = np.sqrt((off**2).mean(1))
        at = int(np.argmin(np.abs(candidates[:, 0].numpy() - found.action)))
        assert missed[at] > 0.8 * missed.max()
    assert beyond.difference > 1.5 * inside.difference > 1.5


SPEEDS = DiscreteActions([1.0, 1.5, 2.0, 2.5, 3.0])


def line(bias, fn=lambda theta, xi: theta * xi):
    """Return a loop with its severe tests."""
    action = torch.tensor([1.0, 2.0, 3.0, 2.0, 1.5])
    trials = Trials(action, slope_world.read(0.7 * action + bias))
    parts = slope_world.model(fn), slope_world.PRIOR, trials
    c = Criticism(*parts, effects=[BIAS], actions=SPEEDS)
    return c, severe_tests(c.rivals, c.trace(), SPEEDS)


def forward(theta, xi):
    if bool((xi < 1).any() or (xi > 3).any()):
        raise ValueError("the gripper pushes at 1 to 3 m/s")
    return theta * xi


def test_only_a_verdict_that_names_effects_is_tested_and_within_the_range():
    right, tests = line(0.0)
    assert right.trace().verdict == "none"
    assert tests == ()
    _, [only] = line(1.0, forward)
    assert only.is_permitted
