"""The gate: each decision on a small case made for it."""

import json

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Trials, close_loop, generic_effects
from sbi_active.criticism.report.gate import EXIT_CODES
from tests.criticism import block
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.effects import BIAS

ACTIONS = DiscreteActions(torch.linspace(-2, 2, 9))


def decided(form, *, prior=PRIOR, fitted=9, held_out=4):
    """Return the gate of trials whose mean is a form of the action and its place."""
    gen = torch.Generator().manual_seed(0)
    num = fitted + held_out
    action = ACTIONS.values[torch.randperm(9, generator=gen).repeat(2)[:num]]
    mean = form(action, torch.arange(num)[:, None] < fitted)
    trials = Trials(
        action, read(mean, gen), role=["fit"] * fitted + ["held out"] * held_out
    )
    report = close_loop(MODEL, prior, trials, effects=[BIAS], plan=False)
    assert report.to_dict()["gate"] == json.loads(json.dumps(report.gate.to_dict()))
    assert report.gate.exit_code == EXIT_CODES[report.gate.decision]
    return report.gate


#: Mean of x, options, decision, and what holds of its details.
CASES = {
    "right": (
        lambda xi, fits: 0.7 * xi,
        *({}, "SHIP", lambda own: own["before"] < 3 * NOISE),
    ),
    "an effect is missing": (
        lambda xi, fits: 0.7 * xi + 0.8,
        *({}, "WRONG_MODEL", lambda own: own["after"] < own["before"] / 2),
    ),
    "nothing is named": (
        lambda xi, fits: 0.7 * xi + torch.sin(4 * xi),
        *({}, "WRONG_MODEL", lambda own: own["worst"]["deviations"] > 1),
    ),
    "held-out trials are missed": (
        lambda xi, fits: 0.7 * xi + torch.where(fits, 0.0, 2.0),
        *({}, "WRONG_MODEL", lambda own: len(own["trials"]) >= 3),
    ),
    "the error is no smaller": (
        lambda xi, fits: 0.7 * xi + torch.where(fits, 0.8, 0.0),
        *({}, "NO_IMPROVEMENT", lambda own: own["after"] > own["before"]),
    ),
    "a positive parameter": (
        lambda xi, fits: 0.1 * xi,
        {"prior": BoxUniform(torch.tensor([0.5]), torch.tensor([3.0]))},
        *("OUT_OF_PRIOR", lambda own: 0 < own["box"]["theta_1"]["lower"] < 0.1),
    ),
    "a truth beyond a bound, which is to be moved": (
        lambda xi, fits: 4.0 * xi,
        *({}, "OUT_OF_PRIOR", lambda own: 4.0 < own["box"]["theta_1"]["upper"] < 6.0),
    ),
    "few trials": (
        lambda xi, fits: 0.7 * xi,
        *({"fitted": 3, "held_out": 1}, "NOT_ENOUGH_DATA", lambda own: True),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_decision_has_its_details(case):
    form, options, decision, holds = CASES[case]
    gate = decided(form, **options)
    assert gate.decision == decision
    assert holds(gate.details)
    for bound in gate.details.get("bounds", ()):
        where = (bound["name"], bound["side"], bound["bound"])
        assert where in [("theta_1", "upper", 3.0), ("theta_1", "lower", 0.5)]
    is_named = decision == "WRONG_MODEL" and gate.details.get("effects") == ["bias"]
    assert is_named == (case == "an effect is missing")


def test_trajectories_that_tell_a_product_alone_are_not_identifiable():
    """Slopes from one side told both factors to a seventh, and the gate shipped."""
    times = torch.linspace(0.1, 2.0, 20)

    def swing(theta, xi):
        rate = (theta[:, :1] * theta[:, 1:]).sqrt()
        return xi * torch.cos(rate * times.to(theta))

    model = SimulatorModel(
        swing, noise=1e-3, parameter_names=["stiffness", "factor"], sample_times=times
    )
    prior = BoxUniform(torch.tensor([1.0, 0.5]), torch.tensor([20.0, 2.0]))
    gen, xi = torch.Generator().manual_seed(0), torch.linspace(0.5, 1.5, 8)[:, None]
    x = swing(torch.tensor([[9.0, 1.1]]).expand(8, -1), xi)
    x = x + 1e-3 * torch.randn(x.shape, generator=gen)
    report = close_loop(model, prior, Trials(xi, x, sample_times=times), plan=False)
    assert report.gate.decision == "NOT_IDENTIFIABLE"
    assert "stiffness" in report.gate.reason
    assert "stiffness * factor = 9.89" in str(report.combinations)
    factor = report.tracing.evidences["none"].draws[:, 1]
    # Its density falls with 1 / factor from .5 to 2.
    assert factor.std() == pytest.approx(0.427, rel=0.12)


def test_three_trials_of_which_one_contradicts():
    model = SimulatorModel(block.stop, noise=block.SENSOR)
    prior, trials = block.friction(0.1), Trials([1.0, 2.0, 3.0], [0.127, 0.510, 2.3])
    effects = generic_effects(model, trials, prior=prior)
    gate = close_loop(model, prior, trials, effects=effects, plan=False).gate
    assert gate.decision == "NOT_ENOUGH_DATA"
    assert gate.details == {"trials": ["2"]}
    assert "trial 2 does not agree" in gate.reason
