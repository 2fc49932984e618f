"""The gate: each decision on a small case made for it."""

import json

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials, close_loop, generic_effects
from sbi_active.criticism.report.gate import EXIT_CODES
from tests.effects import BIAS

NOISE = 0.1
PRIOR = BoxUniform(-3 * torch.ones(1), 3 * torch.ones(1))
MODEL = SimulatorModel(
    lambda theta, xi: theta * xi + 0 * xi,
    noise=GaussianNoise(NOISE),
    parameter_names=["slope"],
)
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 9))


def decided(form, *, model=MODEL, prior=PRIOR, fitted=9, held_out=4, seed=0):
    """Return the gate of trials whose mean is a form of the action and its place."""
    gen = torch.Generator().manual_seed(seed)
    num = fitted + held_out
    action = ACTIONS.values[torch.randperm(9, generator=gen).repeat(2)[:num]]
    mean = form(action, torch.arange(num)[:, None] < fitted)
    x = mean + NOISE * torch.randn(mean.shape, generator=gen)
    trials = Trials(action, x, role=["fit"] * fitted + ["held out"] * held_out)
    report = close_loop(model, prior, trials, effects=[BIAS], plan=False)
    assert report.to_dict()["gate"] == json.loads(json.dumps(report.gate.to_dict()))
    assert report.gate.exit_code == EXIT_CODES[report.gate.decision]
    return report.gate


def test_a_right_simulator_ships():
    gate = decided(lambda xi, fits: 0.7 * xi)
    assert (gate.decision, gate.exit_code) == ("SHIP", 0)
    assert gate.details["before"] < 3 * NOISE


def test_an_effect_that_is_missing_is_named():
    gate = decided(lambda xi, fits: 0.7 * xi + 0.8)
    assert gate.decision == "WRONG_MODEL"
    assert gate.details["effects"] == ["bias"]
    assert gate.details["after"] < gate.details["before"] / 2


def test_where_a_simulator_misses_is_said_if_nothing_is_named():
    gate = decided(lambda xi, fits: 0.7 * xi + torch.sin(4 * xi))
    assert gate.decision == "WRONG_MODEL"
    assert not gate.details["effects"]
    assert gate.details["worst"]["deviations"] > 1


def test_held_out_trials_that_are_missed_close_the_gate():
    gate = decided(lambda xi, fits: 0.7 * xi + torch.where(fits, 0.0, 2.0))
    assert gate.decision == "WRONG_MODEL"
    assert len(gate.details["trials"]) >= 3


def test_an_effect_that_does_not_lower_the_error_is_no_improvement():
    gate = decided(lambda xi, fits: 0.7 * xi + torch.where(fits, 0.8, 0.0))
    assert gate.decision == "NO_IMPROVEMENT"
    assert "bias" in gate.reason
    assert gate.details["after"] > gate.details["before"]


def test_a_truth_outside_the_prior_says_which_bound_to_move():
    gate = decided(lambda xi, fits: 4.0 * xi)
    assert gate.decision == "OUT_OF_PRIOR"
    (bound,) = gate.details["bounds"]
    assert (bound["name"], bound["side"], bound["bound"]) == ("slope", "upper", 3.0)
    assert 4.0 < gate.details["box"]["slope"]["upper"] < 6.0


def test_a_wider_box_keeps_the_sign_of_what_is_positive():
    prior = BoxUniform(torch.tensor([0.5]), torch.tensor([3.0]))
    gate = decided(lambda xi, fits: 0.1 * xi, prior=prior)
    assert gate.decision == "OUT_OF_PRIOR"
    assert 0 < gate.details["box"]["slope"]["lower"] < 0.1


def test_parameters_that_are_known_together_alone_are_not_identifiable():
    model = SimulatorModel(
        lambda theta, xi: theta[:, :1] * theta[:, 1:] * xi,
        noise=GaussianNoise(NOISE),
        parameter_names=["mass", "drag"],
    )
    prior = BoxUniform(0.2 * torch.ones(2), 3 * torch.ones(2))
    gate = decided(lambda xi, fits: 1.2 * xi, model=model, prior=prior)
    assert gate.decision == "NOT_IDENTIFIABLE"
    assert "mass" in gate.reason
    assert "drag" in gate.reason


def test_trajectories_that_tell_a_product_alone_are_not_identifiable():
    """Slopes from one side told both factors to a seventh, and the gate shipped."""
    times = torch.linspace(0.1, 2.0, 20)

    def swing(theta, xi):
        rate = (theta[:, :1] * theta[:, 1:]).sqrt()
        return xi * torch.cos(rate * times.to(theta))

    model = SimulatorModel(
        swing,
        noise=GaussianNoise(1e-3),
        parameter_names=["stiffness", "factor"],
        sample_times=times,
    )
    prior = BoxUniform(torch.tensor([1.0, 0.5]), torch.tensor([20.0, 2.0]))
    gen, xi = torch.Generator().manual_seed(0), torch.linspace(0.5, 1.5, 8)[:, None]
    x = swing(torch.tensor([[9.0, 1.1]]).expand(8, -1), xi)
    x = x + 1e-3 * torch.randn(x.shape, generator=gen)
    report = close_loop(model, prior, Trials(xi, x, sample_times=times), plan=False)
    assert report.gate.decision == "NOT_IDENTIFIABLE"
    assert "stiffness * factor = 9.89" in str(report.combinations)
    factor = report.tracing.evidences["none"].draws[:, 1]
    # Its density falls with 1 / factor from .5 to 2.
    assert factor.std() == pytest.approx(0.427, rel=0.12)


def test_few_trials_are_not_enough():
    gate = decided(lambda xi, fits: 0.7 * xi, fitted=3, held_out=1)
    assert gate.decision == "NOT_ENOUGH_DATA"
    assert "measure more" in gate.reason


def test_three_trials_of_which_one_contradicts():
    block = SimulatorModel(
        lambda theta, v: v**2 / (19.62 * theta), noise=GaussianNoise(0.005)
    )
    prior = BoxUniform(torch.tensor([0.1]), torch.tensor([1.0]))
    trials = Trials([1.0, 2.0, 3.0], [0.127, 0.510, 2.3])
    effects = generic_effects(block, trials, prior=prior)
    gate = close_loop(block, prior, trials, effects=effects, plan=False).gate
    assert gate.decision == "NOT_ENOUGH_DATA"
    assert gate.details == {"trials": ["2"]}
    assert "trial 2 does not agree" in gate.reason
