"""Batches and pending trials against the linear-Gaussian closed form."""

import math

import pytest
import torch

from sbi_active.actions import DiscreteActions
from sbi_active.design import InformationGainDesigner, LikelihoodGain
from sbi_active.design.outcomes import JointLikelihood, conditional_gain, join_outcomes
from sbi_active.simulation import AutocorrelatedNoise, SimulatorModel
from tests.linear_gaussian import PRIOR, ExactLikelihood, candidates, require_near

ANGLES = DiscreteActions([0.0, 0.25, 1.0], names=["angle"])


def direction(action):
    """Rows h of x = h theta + noise: a turn, and the shorter the farther."""
    turn = 0.5 * torch.pi * action
    return (4 - 1.5 * action) * torch.cat([turn.cos(), turn.sin()], 1)


def along(theta, action):
    return (direction(action) * theta).sum(1, keepdim=True)


def joint(*actions):
    """Exact information of trials at the same parameters."""
    h = direction(torch.tensor(actions)[:, None]).double()
    return 0.5 * float(torch.logdet(torch.eye(2).double() + h.T @ h))


MODEL = SimulatorModel(along, noise=1.0)


def select(simulator=MODEL, **options):
    designer = InformationGainDesigner(ANGLES, num_samples=1_000)
    return designer.select(None, simulator, belief=PRIOR, seed=0, **options)


def test_a_batch_is_chosen_by_joint_information():
    design = select(num_actions=2)
    assert design.action.tolist() == [[0.0], [1.0]]  # at a right angle
    # negative control: by itself the second best is close to the best
    alone = select()
    order = alone.expected_information_gain.argsort(descending=True)
    assert ANGLES.values[order[1]].tolist() == [0.25]
    first, last = design.steps
    exact = joint(0.0)
    gain = float(first.expected_information_gain[first.index])
    error = float(first.standard_error[first.index])
    assert abs(gain - exact) < 4 * error + 0.05
    given = torch.tensor([joint(0.0, float(a)) - exact for a in ANGLES.values])
    require_near(last, given, 0.1)
    assert abs(design.joint_information_gain - joint(0.0, 1.0)) < 0.4
    assert design.num_simulations == sum(s.num_simulations for s in design.steps)


def test_pending_trials_count_as_known():
    design = select(pending=torch.tensor([[0.0]]))
    assert design.action.tolist() == [1.0]
    assert design.bound == "none"
    given = torch.tensor([joint(0.0, float(a)) - joint(0.0) for a in ANGLES.values])
    require_near(design, given, 0.1)
    third = select(pending=torch.tensor([[0.0], [1.0]]))
    assert float(third.expected_information_gain.max()) < 1.0  # both directions known


def test_joint_noise_keeps_its_time_axis():
    def constant(theta, action):
        return along(theta, action)[:, :, None].expand(-1, 3, 1)

    noise = AutocorrelatedNoise(1.0, correlation_time=1e-6).at(torch.arange(3.0))
    model = SimulatorModel(constant, noise=noise)
    design = select(simulator=model, pending=torch.tensor([[0.0]]))
    assert design.action.tolist() == [1.0]
    h = 3**0.5 * direction(torch.tensor([[0.0], [1.0]])).double()
    logdet = [torch.logdet(torch.eye(2).double() + r.T @ r) for r in (h, h[:1])]
    exact = 0.5 * float(logdet[0] - logdet[1])
    gain = float(design.expected_information_gain[design.index])
    assert abs(gain - exact) < 4 * float(design.standard_error[design.index]) + 0.1


# Outcomes with many numbers, compared by a few summaries of them


NUM = 300
TIMES = torch.linspace(0.1, 1.0, NUM)
BASIS = torch.stack([TIMES, torch.sin(8 * TIMES)])


def line(theta, action):
    return action * (theta @ BASIS)


def exact(action: float, sd: float) -> float:
    precision = torch.eye(2) + (action / sd) ** 2 * BASIS @ BASIS.T
    return 0.5 * float(torch.logdet(precision.double()))


def test_a_linear_model_tells_what_it_tells_in_closed_form():
    model = SimulatorModel(line, noise=2.0)
    actions = DiscreteActions([0.2, 1.0, 3.0])
    designer = InformationGainDesigner(actions, num_samples=1_000)
    design = designer.select(None, model, belief=PRIOR, seed=0)
    error = design.standard_error.nan_to_num(0.0)
    for k, action in enumerate((0.2, 1.0, 3.0)):
        gain = float(design.expected_information_gain[k])
        assert abs(gain - exact(action, 2.0)) < 4 * float(error[k]) + 0.03
    assert float(design.action) == 3.0
    text = "32 linear summaries stand for the 300 numbers"
    assert any(text in note for note in design.notes)


# Outcomes of several actions together


def test_what_an_action_tells_beyond_others_has_a_closed_form():
    rows = candidates(torch.tensor([[0.5], [2.0], [1.0], [1.5]]), 4_000)
    own, others = (rows.candidates(torch.tensor(k)) for k in ([0, 1], [2, 3]))
    model, estimator = ExactLikelihood(), LikelihoodGain(num_contrastive=1_000)
    given = JointLikelihood(model, 1), join_outcomes(own, others), PRIOR, 2
    gain = conditional_gain(estimator, *given)
    known = 1 + float(others.action.square().sum())
    exact = [2 * 0.5 * math.log1p(a**2 / known) for a in (0.5, 2.0)]
    assert gain.mean(1).tolist() == pytest.approx(exact, abs=0.04)
