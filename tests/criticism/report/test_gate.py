"""The gate: each decision on a small case made for it."""

import json
from dataclasses import replace

import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import chi2, norm

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Trials, close_loop, generic_effects
from sbi_active.criticism.report.gate import EXIT_CODES
from tests.criticism import block
from tests.criticism.slope_world import MODEL, NOISE, PRIOR, read
from tests.effects import BIAS, with_error

ACTIONS = DiscreteActions(torch.linspace(-2, 2, 9))


def decided(form, *, prior=PRIOR, fitted=9, held_out=4):
    """Return the gate of trials whose mean is a form of the action and its place."""
    gen = torch.Generator().manual_seed(0)
    num = fitted + held_out
    action = ACTIONS.values[torch.randperm(9, generator=gen).repeat(2)[:num]]
    mean = form(action, torch.arange(num)[:, None] < fitted)
    role = ["fit"] * fitted + ["held out"] * held_out
    trials = Trials(action, read(mean, gen), role=role)
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
    xi = torch.linspace(0.5, 1.5, 8)[:, None]
    x = with_error(swing(torch.tensor([[9.0, 1.1]]).expand(8, -1), xi), 1e-3)
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
    report = close_loop(model, prior, trials, effects=effects, plan=False)
    assert report.gate.decision == "NOT_ENOUGH_DATA"
    assert report.gate.details == {"trials": ["2"]}
    assert "trial 2 does not agree" in report.gate.reason
    some = replace(report, tracing=replace(report.tracing, outliers={}))
    assert "one trial does not agree" in some.gate.reason


def left_out(x, noise=NOISE):
    """Return the gate of trials at actions of one, each predicted by the others."""
    model = SimulatorModel(MODEL.fn, noise=noise)
    trials = Trials(torch.ones(len(x)), x)
    return close_loop(model, PRIOR, trials, effects=[BIAS], plan=False).gate


def test_two_of_five_that_fit_together_are_not_missed():
    """Both lie outside the others' 90 %: errors of left-out trials share the others."""
    off = NOISE * torch.tensor([1.7, -1.7, 0.0, 0.0, 0.0])
    assert (off[0] * 5 / 4) / (NOISE * (1 + 1 / 4) ** 0.5) > norm.ppf(0.95)
    assert chi2.sf(float((off / NOISE).square().sum()), 4) > 0.2
    assert left_out(0.7 + off).decision == "SHIP"


@pytest.mark.parametrize(
    ("off", "decision"),
    [([2.2, 0.3, -0.5], "SHIP"), ([9.0, 9.0, 9.0], "WRONG_MODEL")],
)
def test_one_of_three_outside_its_90_percent_is_chance(off, decision):
    """A right random simulator has one of three such numbers in 27 % of sets."""

    def line(theta, xi):
        return theta * xi + NOISE * torch.randn(max(len(theta), len(xi)), 1)

    gen, xi = torch.Generator().manual_seed(0), ACTIONS.values[[*range(9), 1, 4, 7]]
    error = torch.cat([torch.randn(9, generator=gen), torch.tensor(off)])[:, None]
    role = ["fit"] * 9 + ["held out"] * 3
    trials = Trials(xi, 0.7 * xi + NOISE * error, role=role)
    report = close_loop(SimulatorModel(line), PRIOR, trials, effects=[BIAS], plan=False)
    assert report.gate.decision == decision
    within = report.evaluation.before["coverage"].mean()
    assert within == pytest.approx(2 / 3 if decision == "SHIP" else 0)


@pytest.mark.parametrize(
    ("num", "decision"), [(1, "NOT_ENOUGH_DATA"), (2, "WRONG_MODEL")]
)
def test_what_cannot_be_without_a_measurement_does_not_ship(num, decision):
    off = NOISE * torch.tensor([0.7, -0.7, 0.0, 0.5, -0.5])
    gate = left_out(torch.cat([0.7 + off, torch.full((num,), torch.nan)]))
    assert gate.decision == decision
    assert gate.details == {"trials": ["5", "6"][:num]}
    assert "no measurement where the model is sure of one" in gate.reason


def test_copies_of_trajectories_are_no_further_trials():
    """Their deviation fell with every copy, and the gate counted each."""
    times, gen = torch.linspace(0.1, 2.0, 20), torch.Generator().manual_seed(0)
    model = SimulatorModel(
        lambda theta, xi: xi * torch.exp(-theta * times),
        noise=NOISE,
        sample_times=times,
    )
    xi = torch.tensor([[3.0], [2.0], [4.0], [5.0]])
    x = xi * torch.exp(-0.8 * times) + NOISE * torch.randn(4, 20, generator=gen)
    for copies, decision in ((1, "SHIP"), (3, "NOT_ENOUGH_DATA")):
        own = [part.repeat(copies, 1) for part in (xi, x)]
        trials = Trials(*own, sample_times=times)
        report = close_loop(model, PRIOR, trials, effects=[BIAS], plan=False)
        assert report.gate.decision == decision
    assert report.gate.details["alike"] < 1e-4
    assert "SA534" in [warning.code for warning in report.warnings]


@pytest.mark.parametrize(("times", "ships"), [(1.2, True), (10.0, False)])
def test_a_noise_declared_too_large_hides_what_is_missing(times, ships):
    rank = torch.randperm(80, generator=torch.Generator().manual_seed(0))
    off = NOISE * norm.ppf((rank.numpy() + 0.5) / 80)
    gate = left_out(0.7 + torch.tensor(off).float(), noise=times * NOISE)
    assert (gate.decision == "SHIP") == ships
    if not ships:
        left = (off @ off / 79) ** 0.5 / (times * NOISE)
        assert gate.decision == "NOT_ENOUGH_DATA"
        assert gate.details["residuals"] == pytest.approx(left, rel=0.02)


def test_a_parameter_whose_sign_no_trial_tells_is_not_known():
    """One sign was said to be known to a hundredth, and the gate shipped."""
    model = SimulatorModel(lambda theta, xi: theta**2 * xi, noise=NOISE)
    xi = torch.linspace(-2, 2, 12)[:, None]
    trials = Trials(xi, read(4.0 * xi))
    report = close_loop(model, PRIOR, trials, effects=[BIAS], plan=False)
    assert report.gate.decision == "NOT_ENOUGH_DATA"
    assert report.gate.details == {"parameters": ["theta_1"]}
    slope = report.tracing.evidences["none"].draws[:, 0]
    exact = (xi.square().sum() ** -0.5 * NOISE / 4).item()  # of either sign
    assert abs(slope).mean() == pytest.approx(2.0, abs=4 * exact)
    assert abs(slope).std() == pytest.approx(exact, rel=0.2)
    assert (slope > 0).mean() == pytest.approx(0.5, abs=0.1)
