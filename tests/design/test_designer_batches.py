"""Batches and pending trials against the linear-Gaussian closed form."""

import pytest
import torch

from sbi_active import (
    AutocorrelatedNoise,
    BoxActions,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)
from tests.linear_gaussian import PRIOR

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


MODEL = SimulatorModel(along, noise=GaussianNoise(1.0))


class Likelihood:
    """The exact likelihood of one outcome."""

    exact_likelihood = True

    def log_likelihood(self, x, theta, action):
        normal = torch.distributions.Normal(along(theta, action), 1.0)
        return normal.log_prob(x).sum(1)


def select(
    actions=ANGLES,
    model=None,
    simulator=MODEL,
    estimator="auto",
    num_samples=1_000,
    **options,
):
    designer = InformationGainDesigner(
        actions, num_samples=num_samples, estimator=estimator
    )
    return designer.select(model, simulator, belief=PRIOR, seed=0, **options)


def test_a_batch_is_chosen_by_joint_information():
    design = select(num_actions=2)
    assert design.action.tolist() == [[0.0], [1.0]]  # at a right angle
    assert design.steps[1].candidates.shape == (3, 1)
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
    distance = (last.expected_information_gain - given).abs()
    assert (distance < 4 * last.standard_error + 0.1).all()
    assert abs(design.joint_information_gain - joint(0.0, 1.0)) < 0.4
    assert design.num_simulations == sum(s.num_simulations for s in design.steps)
    assert repr(design).startswith("Design(2 actions, joint EIG 2.")


def test_pending_trials_count_as_known():
    design = select(pending=torch.tensor([[0.0]]))
    assert design.action.tolist() == [1.0]
    assert design.bound == "none"
    given = torch.tensor([joint(0.0, float(a)) - joint(0.0) for a in ANGLES.values])
    distance = (design.expected_information_gain - given).abs()
    assert (distance < 4 * design.standard_error + 0.1).all()
    third = select(pending=torch.tensor([[0.0], [1.0]]))
    assert float(third.expected_information_gain.max()) < 1.0  # both directions known


def test_a_repeat_tells_half_a_bit_more():
    """Noise of pending trials is their own: the same action again is no copy."""
    only = DiscreteActions([0.0])
    design = select(only, pending=torch.tensor([[0.0]]))
    exact = joint(0.0, 0.0) - joint(0.0)
    gain, error = design.expected_information_gain[0], design.standard_error[0]
    assert abs(float(gain) - exact) < 4 * float(error) + 0.05


@pytest.mark.parametrize("model", [None, Likelihood()])
def test_undeclared_noise_and_likelihoods_have_joint_information(model):
    def plain(theta, action):
        return along(theta, action) + torch.randn(len(theta), 1)

    estimator = "likelihood" if model is not None else "auto"
    design = select(
        model=model, simulator=plain, estimator=estimator, pending=torch.tensor([0.0])
    )
    assert design.action.tolist() == [1.0]
    given = torch.tensor([joint(0.0, float(a)) - joint(0.0) for a in ANGLES.values])
    distance = (design.expected_information_gain - given).abs()
    assert (distance < 4 * design.standard_error + 0.2).all()


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


def test_a_batch_in_a_continuous_space():
    design = select(BoxActions(0.0, 1.0), num_actions=2, num_samples=400)
    assert design.action.shape == (2, 1)
    first, second = design.action[:, 0].tolist()
    grid = torch.linspace(0, 1, 101).tolist()
    assert joint(0.0) - joint(first) < 0.1
    assert max(joint(first, b) for b in grid) - joint(first, second) < 0.1
