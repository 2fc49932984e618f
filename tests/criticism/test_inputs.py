"""The loop on recordings with inputs over time and measured start states."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import (
    AugmentedSimulator,
    Criticism,
    Trials,
    close_loop,
    generic_effects,
)
from sbi_active.criticism.report.figures import figures
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from tests.criticism.motor_world import LIBRARY, MODEL, PRIOR, measured
from tests.effects import on_outcomes


def test_what_a_motor_lacks_is_found():
    report = close_loop(MODEL, PRIOR, measured(0, {"coulomb": 0.4}), effects=LIBRARY)
    assert report.verdict == "coulomb"
    rmse = report.before_after.set_index("metric").loc["rmse"]
    assert rmse["after"] < 0.06 < rmse["before"]
    assert "trial from" not in str(report)
    panels = [ax.get_xlabel() for ax in figures(report)["residuals"].axes]
    assert panels == ["trial", "time [s]"] * 2  # the label has none of its own


def test_a_right_model_is_left_alone():
    found = Criticism(MODEL, PRIOR, measured(3, {}), effects=LIBRARY)
    assert found.trace().verdict == "none"


def test_only_recorded_inputs_are_proposed():
    trials = measured(0, {"dead zone": 0.25}, num=5)
    loop = Criticism(MODEL, PRIOR, trials, effects=LIBRARY, actions=trials.action)
    listed = loop.actions.listed()
    assert listed[:, 0].tolist() == [0, 1, 2, 3, 4]
    report = loop.report(evaluate=False)
    assert report.next_action.candidates[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert all(test.is_permitted for test in report.severe_tests)


def summed(theta, action, *, inputs, start=0.0):
    return theta * inputs["u"].sum(1, keepdim=True) + action + start


def test_equal_actions_with_other_inputs_are_other_rows():
    model = SimulatorModel(summed, noise=GaussianNoise(0.1))
    inputs = torch.tensor([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0]])
    keywords = {"inputs": {"u": inputs}, "input_times": [0.0, 1.0]}
    trials = Trials(torch.zeros(3), torch.zeros(3), **keywords)
    assert trials.repeat_of.tolist() == [-1, -1, 0]
    simulator = TrialSimulator(AugmentedSimulator(model, []), trials)
    mean, _, _ = simulator.predict(torch.ones(1, 1), {})
    assert mean.tolist() == [[3.0, 7.0, 3.0]]
    start = Trials(torch.zeros(3), torch.zeros(3), start=[1.0, 2.0, 3.0], **keywords)
    assert start.repeat_of.tolist() == [-1, -1, -1]
    simulator = TrialSimulator(AugmentedSimulator(model, []), start)
    mean, _, _ = simulator.predict(torch.ones(1, 1), {})
    assert mean.tolist() == [[4.0, 9.0, 6.0]]


def test_a_function_of_one_row_gets_its_own_inputs():
    shapes = []

    def one(theta, action, *, inputs, times, input_times, start):
        shapes.append((inputs["u"].shape, times.shape, input_times.shape, start.shape))
        return theta * inputs["u"].sum() + start[0]

    model = SimulatorModel(one, noise=GaussianNoise(0.1), batched=False)
    trials = Trials(
        None,
        torch.zeros(2, 1),
        sample_times=[0.5],
        inputs={"u": torch.tensor([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]])},
        input_times=[0.0, 0.5, 1.0],
        start=torch.tensor([[1.0, 0.0], [2.0, 0.0]]),
    )
    simulator = TrialSimulator(AugmentedSimulator(model, []), trials)
    mean, _, _ = simulator.predict(torch.ones(1, 1), {})
    assert mean.tolist() == [[4.0, 9.0]]
    assert {*shapes} == {((3,), (1,), (3,), (2,))}


def falling(theta, action, *, times):  # which cannot do without them
    return action - 0.5 * theta * times**2


@pytest.mark.parametrize("by_model", [True, False])
def test_a_simulator_may_require_times(by_model):
    times = torch.linspace(0.1, 1.0, 8)
    noise = GaussianNoise(0.02)
    model = SimulatorModel(
        falling, noise=noise, sample_times=times if by_model else None
    )
    prior = BoxUniform(torch.tensor([5.0]), torch.tensor([15.0]))
    action = torch.linspace(1, 3, 6)[:, None]
    gen = torch.Generator().manual_seed(0)
    x = falling(torch.tensor([[9.81]]), action, times=times) + 0.3
    x = x + 0.02 * torch.randn(x.shape, generator=gen)
    trials = Trials(action, x, sample_times=times)
    bias = on_outcomes("bias", lambda x, phi, action, context: x + phi, sd=0.5)
    effects = [bias]
    if by_model:
        generic = generic_effects(model, DiscreteActions(action), prior=prior)
        effects += [e for e in generic if e.name not in ("bias", "action offset")]
    report = close_loop(
        model, prior, trials, effects=effects, evaluate=False, plan=False
    )
    assert report.verdict == "bias"


def test_what_was_found_can_be_simulated_on():
    trials = measured(0, {"dead zone": 0.25})
    loop = Criticism(MODEL, PRIOR, trials, effects=LIBRARY)
    model, prior = loop.add()
    assert prior.event_shape == (3,)
    run = {
        "inputs": trials.inputs,
        "input_times": trials.input_times,
        "times": trials.sample_times.expand(len(trials), -1),
        "start": trials.start,
    }
    z = torch.tensor([[3.0, 0.3, 0.25]]).double().expand(len(trials), -1)
    x = model.mean(z, trials.action, **run)
    assert float((x - trials.x).square().mean().sqrt()) < 0.06
    without = model.mean(
        torch.cat([z[:, :2], torch.zeros(len(z), 1)], 1), trials.action, **run
    )
    assert float((without - trials.x).square().mean().sqrt()) > 0.1
