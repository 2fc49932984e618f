"""A confident alias: what the report says, and the actions that would show it."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Trials, generic_effects
from sbi_active.criticism.next_action import beyond_range, following, severe_tests
from sbi_active.criticism.steps.predictive import predict
from tests.criticism import slope_world
from tests.effects import BIAS

NOISE = 0.01
ANGLES = DiscreteActions(
    torch.linspace(0.2, 1.2, 11).double(), names=["angle"], units=["rad"]
)
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
    model = SimulatorModel(pendulum, noise=GaussianNoise(NOISE), parameter_names=names)
    prior = BoxUniform(torch.tensor([0.3, 0.0]), torch.tensor([2.0, 1.0]))
    generator = torch.Generator().manual_seed(1)
    action = ANGLES.values[torch.randperm(11, generator=generator)[:8]]
    x = truth(action)
    x = x + NOISE * torch.randn(x.shape, generator=generator)
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
