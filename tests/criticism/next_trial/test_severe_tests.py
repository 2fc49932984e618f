"""A confident alias: what the report says, and the actions that would show it."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.actions import ActionSpace
from sbi_active.criticism import Criticism, Trials, generic_effects
from sbi_active.criticism.next_trial.candidates import extrapolated
from sbi_active.criticism.next_trial.severe_tests import severe_tests
from sbi_active.criticism.steps.predictive import predict
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
    for k in range(SAMPLES * EVERY):
        half = q + STEP / 2 * v, v + STEP / 2 * force(q, v)
        q, v = q + STEP * half[1], v + STEP * force(*half)
        x += [q] if (k + 1) % EVERY == 0 else []
    return torch.stack(x, 1)


def truth(action):
    """The pendulum with the magnet that its simulator lacks."""
    theta = torch.tensor([[1.0, 0.2]]).double().expand(len(action), 2)
    return pendulum(theta, action, magnet=1.0)


def pushed():
    model = SimulatorModel(
        pendulum, noise=GaussianNoise(NOISE), parameter_names=["length", "damping"]
    )
    prior = BoxUniform(torch.tensor([0.3, 0.0]), torch.tensor([2.0, 1.0]))
    generator = torch.Generator().manual_seed(1)
    action = ANGLES.values[torch.randperm(11, generator=generator)[:8]]
    x = truth(action)
    x = x + NOISE * torch.randn(x.shape, generator=generator)
    gains = [e for e in generic_effects(model, ANGLES) if e.name.endswith(" gain")]
    return Criticism(model, prior, Trials(action, x), effects=gains, actions=ANGLES)


@pytest.fixture(scope="module")
def aliased():
    return pushed()


def test_a_confident_alias_is_told_as_what_it_is(aliased):
    report = aliased.report(evaluate=False)
    assert report.verdict == "action gain + sensor gain"
    assert report.probabilities[report.verdict] > 0.84  # the most that two can have
    length = report.parameters.set_index("parameter").loc["length"]
    assert abs(length["after"] - 1.0) > 5 * length["after_sd"]  # confident, and wrong
    assert "P holds among the declared effects alone" in " ".join(str(report).split())
    tested = [float(t.action[0]) for t in report.severe_tests]
    assert tested == pytest.approx([1.2, 1.7])  # the second is not permitted


def test_the_verdict_fails_most_where_it_is_put_to_the_test(aliased):
    inside, beyond = severe_tests(aliased.rivals, aliased.trace(), ANGLES)
    assert inside.is_permitted
    assert not beyond.is_permitted
    others = extrapolated(ANGLES, ANGLES.values, limit=16)
    for found, candidates in ((inside, ANGLES.values), (beyond, others)):
        missed = [_missed(aliased, action) for action in candidates]
        at = int(np.argmin(np.abs(candidates[:, 0].numpy() - found.action)))
        assert missed[at] > 0.8 * max(missed)
    assert beyond.difference > 1.5 * inside.difference > 1.5


def _missed(criticism, action):
    """Return how far the verdict is from the truth, root mean square over x."""
    from sbi_active.criticism.next_trial.candidates import following

    trials = following(criticism.rivals, action[None])
    key = criticism.trace().key
    mean, _ = predict(criticism.rivals, trials, key=key, scored=False).moments()
    return float(
        np.sqrt(((truth(action[None].double())[0].numpy() - mean) ** 2).mean())
    )


SPEEDS = DiscreteActions([1.0, 1.5, 2.0, 2.5, 3.0])


def line(bias, fn=lambda theta, xi: theta * xi, actions: ActionSpace | None = SPEEDS):
    model = SimulatorModel(fn, noise=GaussianNoise(0.1))
    action = torch.tensor([1.0, 2.0, 3.0, 2.0, 1.5])
    noise = 0.1 * torch.randn(5, generator=torch.Generator().manual_seed(0))
    prior = BoxUniform(-3 * torch.ones(1), 3 * torch.ones(1))
    trials = Trials(action, 0.7 * action + bias + noise)
    return Criticism(model, prior, trials, effects=[BIAS], actions=actions)


def test_only_a_verdict_that_names_effects_is_tested():
    right = line(0.0)
    assert right.trace().verdict == "none"
    assert severe_tests(right.rivals, right.trace(), SPEEDS) == ()
    assert "P holds among" not in str(right.report(evaluate=False))


def test_the_difference_is_that_of_two_predictions():
    c = line(1.0)
    assert c.trace().verdict == "bias"
    [inside, beyond] = severe_tests(c.rivals, c.trace(), SPEEDS)
    again = severe_tests(c.rivals, c.trace(), SPEEDS)
    assert [t.difference for t in again] == [inside.difference, beyond.difference]
    assert bool(SPEEDS.contains(torch.tensor(inside.action).float()))
    assert beyond.action.tolist() in ([0.0], [-0.0], [4.0])
    # Least squares in slope and bias, and in the slope alone, far from the trials.
    t = c.trials
    design = torch.stack([t.action[:, 0], torch.ones(5)], 1).double()
    full = torch.linalg.lstsq(design, t.x).solution[:, 0]
    at = torch.tensor([float(beyond.action[0]), 1.0]).double()
    sd = 0.1 * float(1 + at @ torch.linalg.inv(design.T @ design) @ at) ** 0.5
    slope = float((t.action * t.x).sum() / (t.action**2).sum())
    least = abs(float(full @ at) - slope * float(at[0])) / sd
    assert beyond.difference > 0.8 * least


def test_a_simulator_that_fails_beyond_its_range_is_tested_within():
    def forward(theta, xi):
        if bool((xi < 1).any() or (xi > 3).any()):
            raise ValueError("the gripper pushes at 1 to 3 m/s")
        return theta * xi

    c = line(1.0, forward)
    [only] = severe_tests(c.rivals, c.trace(), SPEEDS)
    assert only.is_permitted
