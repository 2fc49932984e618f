"""Tasks against their equations, and what they are got by."""

import math
from copy import copy

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active import simulate
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.ball_drops import fall  # pyright: ignore
from sbi_active.tasks.chain import model
from sbi_active.tasks.oscillator import reference as reference_module
from sbi_active.tasks.oscillator.model import (
    ACTION_HIGH,
    ACTION_LOW,
    NOISE_SD,
    PRIOR_HIGH,
    PRIOR_LOW,
    SAMPLE_TIMES,
    SENSOR_RANGE,
    mean,
)
from sbi_active.tasks.oscillator.reference import OscillatorReference
from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import answers


def test_unknown_task_lists_the_valid_names():
    with pytest.raises(ValueError, match="expected a task among 'numerical'.*'abc'"):
        get_task("abc")


@pytest.mark.parametrize("variant", ["linear", "sinh", "square"])
def test_the_simulator_and_the_oracle_are_one_model(variant):
    """Ranks of the truth's exact density among exact draws are uniform."""
    task = get_task("numerical", variant=variant)
    num = 80
    theta = task.prior.sample((num,))
    action = task.actions.sample((num,), seed=0)
    x = simulate(task.simulator, theta, action, seed=0).x
    ranks = []
    for i in range(num):
        exact = task.reference(action[i : i + 1], x[i : i + 1])
        draws = exact.log_prob(exact.sample(200, seed=i))
        ranks.append(float((draws < exact.log_prob(theta[i : i + 1])).double().mean()))
    mean = torch.tensor(ranks).mean()
    # A uniform has mean .5 and sd .289.
    assert abs(float(mean) - 0.5) < 4 * 0.289 / num**0.5


# Falling balls: the fall, what it may lack, and the measured drops


G, TIMES = 9.81, torch.linspace(0, 4, 61).double()
LEVEL = torch.zeros(1, 2).double()


@pytest.mark.parametrize("strength", [0.5, 3.0])
@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_the_fall_with_drag_is_the_closed_form(strength, exponent):
    s = (TIMES - 0.2).clamp(min=0)
    if exponent == 1.0:
        c = strength / 10
        way = G / c * s - G / c**2 * (1 - torch.exp(-c * s))
    else:
        k = strength / 100
        way = torch.log(torch.cosh((G * k) ** 0.5 * s)) / k
    drag = torch.tensor([strength]).double()
    args = {"times": TIMES[None], "start": 0.2, "drag": drag, "exponent": exponent}
    x = fall(LEVEL, torch.zeros(1, 1), **args)[0]
    assert float((x - (47 - way)).abs().max()) < 1e-4


def test_every_effect_vanishes_at_its_null_and_moves_x_elsewhere():
    task = get_task("ball_drops")
    theta, action = task.prior.sample((16,)), task.actions.values[:1].repeat(16, 1)
    model = AugmentedSimulator(task.simulator, task.effects(), check=(theta, action))
    bare = model.evaluate(theta, {}, action)
    for effect in task.effects():
        if effect.name == "wind":  # which the drag alone sees
            continue
        phi = effect.sample(16).to(theta.dtype)
        change = (model.evaluate(theta, {effect.name: phi}, action) - bare).abs()
        assert float(change.max()) > 0.01, effect.name


# The chain against an ODE solver, and its options


@pytest.mark.parametrize(("parameters", "moving"), [(5, 3), (6, 2)])
def test_the_closed_form_solves_the_equations(parameters, moving):
    task = get_task("chain", parameters=parameters)
    theta, count = task.theta_true.double(), model.num_masses(parameters)
    k = theta[:count].numpy()
    m = np.append(theta[count:].numpy(), [1.0] * (2 * count - parameters))[:moving]
    right = np.append(k[1:], 0.0)[:moving]
    stiffness = np.diag(k[:moving] + right)
    off = k[1:moving]
    stiffness -= np.diag(off, 1) + np.diag(off, -1)
    root = np.diag(m**-0.5)
    square, mode = np.linalg.eigh(root @ stiffness @ root)
    damping = mode @ np.diag(2 * model.DAMPING * np.sqrt(square)) @ mode.T
    damping = np.diag(m**0.5) @ damping @ np.diag(m**0.5)

    def rate(t, state):
        y, v = np.split(state, 2)
        force = np.zeros(moving)
        force[0] = model.FORCE * np.sin(13.0 * t)
        return np.concatenate([v, (force - stiffness @ y - damping @ v) / m])

    times = model.SAMPLE_TIMES.numpy()
    tight = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
    solved = solve_ivp(rate, (0, 2.0), np.zeros(2 * moving), t_eval=times, **tight)
    action = torch.tensor([[13.0, float(moving)]])
    found = model.mean(theta[None], action)[0].numpy()
    assert found[:moving] == pytest.approx(solved.y[:moving], abs=1e-7)
    assert (found[moving:] == 0).all()


# Location finding: the model and the task


# The oscillator against its differential equation, its reference against itself


def uniform(n: int, low: Tensor, high: Tensor, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(n, len(low), generator=generator, dtype=torch.float64)
    return low + (high.double() - low.double()) * u


# ------------------------------------------------------------------ the model


def test_mean_solves_the_equation_of_motion():
    theta = uniform(6, PRIOR_LOW, PRIOR_HIGH, 0)
    action = uniform(6, ACTION_LOW, ACTION_HIGH, 1)
    theta[0, 3] = 0.0
    action[1, 1] = theta[1, 0]  # at resonance
    times = SAMPLE_TIMES.double().numpy()
    tight = {"method": "DOP853", "t_eval": times, "rtol": 1e-10, "atol": 1e-12}
    pairs = zip(theta.tolist(), action.tolist(), mean(theta, action), strict=True)
    for row, xi, readings in pairs:

        def motion(t, state, row=row, xi=xi):
            (omega_0, zeta, gain, tau), (amplitude, omega) = row, xi
            y, v = state
            force = gain * omega_0**2 * amplitude * math.sin(omega * (t - tau))
            return [v, force - 2 * zeta * omega_0 * v - omega_0**2 * y]

        solved = solve_ivp(motion, (row[3], 4.0), [0.0, 0.0], **tight)
        expected = SENSOR_RANGE * np.tanh(solved.y[0] / SENSOR_RANGE)
        np.testing.assert_allclose(readings, expected, atol=1e-7)


# -------------------------------------------------------------- the posterior


def test_the_reference_has_the_evidence_of_the_oracle():
    own, known = PROBLEMS["oscillator"](), answers()["oscillator"]
    action, x = (torch.from_numpy(v) for v in (own.action, own.x))
    posterior = OscillatorReference(action, x)
    error = math.hypot(known.error, posterior.log_evidence_se)
    assert error < 0.1
    assert abs(posterior.log_evidence - known.log_evidence) < 4 * error
    # negative control: the check sees a noise that is a tenth too large
    wrong, theta = copy(posterior), posterior.sample(4_000, seed=0)
    wrong.noise_sd = 1.1 * NOISE_SD
    ratio = np.exp(wrong._log_of_trials(theta) - posterior._log_of_trials(theta))
    assert abs(np.log(ratio.mean())) > 8 * error


# ------------------------------------------------------- the information gain


def linear_mean(theta: Tensor, action: Tensor) -> Tensor:
    """Outcomes linear in z, where the prior is a standard normal."""
    u = (theta.double() - PRIOR_LOW) / (PRIOR_HIGH.double() - PRIOR_LOW)
    z = torch.special.ndtri(u.clamp(1e-15, 1 - 1e-15))  # finite in the far tails
    return action[..., :1] * (z @ DESIGN)


DESIGN = torch.randn(
    4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64
)


def test_linear_gaussian_limit(monkeypatch):
    r"""EIG = log det(I + A^2 D D^T / sd^2) / 2, after a first trial."""
    monkeypatch.setattr(reference_module, "mean", linear_mean)
    action = torch.tensor([[0.01, 1.0], [0.05, 1.0], [0.15, 1.0]]).double()
    information = DESIGN @ DESIGN.T / NOISE_SD**2
    first = torch.tensor([[0.05, 1.0]]).double()
    x = first[:, :1] * (torch.tensor([[0.5, -0.3, 0.2, 1.0]]).double() @ DESIGN)
    precision = torch.eye(4, dtype=torch.float64) + 0.05**2 * information
    posterior = OscillatorReference(first, x)
    draws = {"num_outer": 1_000, "num_inner": 5_000}
    gain, error = posterior.expected_information_gain(action, **draws)
    after = precision + action[:, :1, None] ** 2 * information
    exact = 0.5 * (torch.logdet(after) - torch.logdet(precision))
    assert bool((error < 0.07).all())
    assert bool(((gain - exact).abs() < 4 * error + 0.01).all())
    covariance = first[0, 0] ** 2 * DESIGN.T @ DESIGN + NOISE_SD**2 * torch.eye(6)
    exact = float(MultivariateNormal(torch.zeros(6).double(), covariance).log_prob(x))
    assert abs(posterior.log_evidence - exact) < 4 * posterior.log_evidence_se
