"""Tasks against their equations, and what they are got by."""

import math
from copy import copy

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy import stats
from scipy.integrate import solve_ivp
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active import simulate
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task
from sbi_active.tasks.ball_drops import fall
from sbi_active.tasks.chain import model
from sbi_active.tasks.numerical.exact import ExactPosterior, noise_free
from sbi_active.tasks.numerical.exact_evidence import RESPONSES
from sbi_active.tasks.oscillator import model as oscillator
from sbi_active.tasks.oscillator import reference as reference_module
from sbi_active.tasks.oscillator.reference import OscillatorReference
from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import answers


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


# The oscillator against its differential equation, its reference against itself


def test_mean_solves_the_equation_of_motion():
    prior = BoxUniform(oscillator.PRIOR_LOW, oscillator.PRIOR_HIGH)
    actions = BoxUniform(oscillator.ACTION_LOW, oscillator.ACTION_HIGH)
    theta, action = (space.sample((6,)).double() for space in (prior, actions))
    theta[0, 3] = 0.0
    action[1, 1] = theta[1, 0]  # at resonance
    times, most = oscillator.SAMPLE_TIMES.double().numpy(), oscillator.SENSOR_RANGE
    tight = {"method": "DOP853", "t_eval": times, "rtol": 1e-10, "atol": 1e-12}
    found = oscillator.mean(theta, action)
    for row, xi, readings in zip(theta.tolist(), action.tolist(), found, strict=True):

        def motion(t, state, row=row, xi=xi):
            (omega_0, zeta, gain, tau), (amplitude, omega) = row, xi
            y, v = state
            force = gain * omega_0**2 * amplitude * math.sin(omega * (t - tau))
            return [v, force - 2 * zeta * omega_0 * v - omega_0**2 * y]

        solved = solve_ivp(motion, (row[3], 4.0), [0.0, 0.0], **tight)
        expected = most * np.tanh(solved.y[0] / most)
        np.testing.assert_allclose(readings, expected, atol=1e-7)


def test_the_reference_has_the_evidence_of_the_oracle():
    own, known = PROBLEMS["oscillator"](), answers()["oscillator"]
    action, x = (torch.from_numpy(v) for v in (own.action, own.x))
    posterior = OscillatorReference(action, x)
    error = math.hypot(known.error, posterior.log_evidence_se)
    assert error < 0.1
    assert abs(posterior.log_evidence - known.log_evidence) < 4 * error
    # negative control: the check sees a noise that is a tenth too large
    wrong, theta = copy(posterior), posterior.sample(4_000, seed=0)
    wrong.noise_sd = 1.1 * SD
    ratio = np.exp(wrong._log_of_trials(theta) - posterior._log_of_trials(theta))
    assert abs(np.log(ratio.mean())) > 8 * error


def linear_mean(theta: Tensor, action: Tensor) -> Tensor:
    """Outcomes linear in z, where the prior is a standard normal."""
    low, high = oscillator.PRIOR_LOW.double(), oscillator.PRIOR_HIGH.double()
    u = (theta.double() - low) / (high - low)
    z = torch.special.ndtri(u.clamp(1e-15, 1 - 1e-15))  # finite in the far tails
    return action[..., :1] * (z @ DESIGN)


SD = oscillator.NOISE_SD
DESIGN = torch.randn(4, 6, generator=torch.Generator().manual_seed(0)).double()


def test_linear_gaussian_limit(monkeypatch):
    r"""EIG = log det(I + A^2 D D^T / sd^2) / 2, after a first trial."""
    monkeypatch.setattr(reference_module, "mean", linear_mean)
    action = torch.tensor([[0.01, 1.0], [0.05, 1.0], [0.15, 1.0]]).double()
    information = DESIGN @ DESIGN.T / SD**2
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
    covariance = first[0, 0] ** 2 * DESIGN.T @ DESIGN + SD**2 * torch.eye(6)
    exact = float(MultivariateNormal(torch.zeros(6).double(), covariance).log_prob(x))
    assert abs(posterior.log_evidence - exact) < 4 * posterior.log_evidence_se


# The exact posterior of the numerical task, its predictive and its gain


VARIANTS = tuple(RESPONSES)


THETA_TRUE = (-3.0, 1.0)
HISTORIES = {
    "prior": [],
    "ridge": [-5.0],
    "theta_1 unidentified": [5.0],
    "theta_2 unidentified": [0.0],
    "off grid": [2.6, -0.3],
    "repeated": [-5.0, 5.0, 5.0, -5.0],
    "twelve": [-4.5, 0.0, 3.3] * 4,
}
each_variant = pytest.mark.parametrize("variant", VARIANTS)
#: Every history of the linear response, and two of the others.
CASES = [("linear", history) for history in HISTORIES]
CASES += [(v, h) for v in VARIANTS[1:] for h in ("off grid", "repeated")]


def posterior_of(history: str, variant: str = "linear") -> ExactPosterior:
    action = HISTORIES[history]
    noise = np.random.default_rng(0).standard_normal(len(action))
    x = noise_free([THETA_TRUE], action, variant=variant)[0].numpy() + noise
    return ExactPosterior(action, x, variant=variant)


def gain_error(posterior: ExactPosterior, action: float) -> float:
    """Monte Carlo gain less the exact one, in Monte Carlo standard errors."""
    rng = np.random.default_rng(1)
    theta = posterior.sample(1500, seed=rng)
    noise = torch.from_numpy(rng.standard_normal(len(theta)))
    x = noise_free(theta, [action], variant=posterior.variant)[:, 0] + noise
    log_likelihood = -0.5 * noise**2 - 0.5 * np.log(2 * np.pi)
    gain = log_likelihood - posterior.log_predictive(x, action)
    exact = posterior.expected_information_gain([action])[0]
    return float((gain.mean() - exact) / (gain.std() / len(gain) ** 0.5))


def cells(posterior: ExactPosterior) -> tuple[np.ndarray, np.ndarray]:
    """Edges and probabilities of cells by the midpoint rule.

    They cover the samples with a margin, of theta_1 > 0 alone where g is even.
    """
    is_even = posterior.variant == "square"
    theta = posterior.sample(4000, seed=3).numpy()
    if is_even:
        theta[:, 0] = abs(theta[:, 0])
    margin = 0.5 * np.ptp(theta, axis=0)
    low = np.maximum(theta.min(0) - margin, [0.0 if is_even else -5.0, -5.0])
    edges = np.linspace(low, np.minimum(theta.max(0) + margin, 5.0), 801)
    centers = 0.5 * (edges[1:] + edges[:-1])
    grid = np.stack(np.meshgrid(*centers.T, indexing="ij"), -1).reshape(-1, 2)
    mass = posterior.log_prob(grid).exp().reshape(800, 800).numpy()
    return edges, mass / mass.sum()


@each_variant
@pytest.mark.parametrize("action", [[2.0, 5.0], [4.0, 2.5, 3.5]])
def test_evidence_against_prior_samples(action: list[float], variant: str) -> None:
    x = [0.4, -1.0, 2.0][: len(action)]
    theta = np.random.default_rng(4).uniform(-5, 5, (400_000, 2))
    residual = np.array(x) - noise_free(theta, action, variant=variant).numpy()
    likelihood = stats.norm.pdf(residual).prod(1)
    standard_error = likelihood.std() / len(theta) ** 0.5
    evidence = np.exp(ExactPosterior(action, x, variant=variant).log_evidence)
    assert abs(likelihood.mean() - evidence) < 4 * standard_error
    assert standard_error < 0.03 * evidence  # or the check would be blunt


@pytest.mark.parametrize(("variant", "history"), CASES)
def test_samples_follow_the_density(history: str, variant: str) -> None:
    posterior = posterior_of(history, variant)
    edges, mass = cells(posterior)
    theta = posterior.sample(4000, seed=5).numpy()
    if variant == "square":
        positive = theta[:, 0] > 0
        assert abs(positive.mean() - 0.5) < 4 * 0.5 / len(theta) ** 0.5
        theta = theta * np.where(positive, 1.0, -1.0)[:, None] ** [1, 0]
    for k in range(2):
        cdf = np.append(0.0, mass.sum(1 - k).cumsum())
        p = stats.kstest(
            theta[:, k], lambda t, k=k, c=cdf: np.interp(t, edges[:, k], c)
        )
        assert p[1] > 1e-3
    center = 0.5 * (edges[1:] + edges[:-1])
    mean = np.array([center[:, 0] @ mass.sum(1), center[:, 1] @ mass.sum(0)])
    off = center - mean
    product = (theta - mean).prod(1)
    error = product.std() / len(theta) ** 0.5
    assert abs(product.mean() - off[:, 0] @ mass @ off[:, 1]) < 4 * error


@each_variant
@pytest.mark.parametrize("history", ["prior", "twelve"])
def test_gain_against_monte_carlo(history: str, variant: str) -> None:
    posterior = posterior_of(history, variant)
    for action in (-5.0, 3.7):
        assert abs(gain_error(posterior, action)) < 4, action


def test_gain_of_the_prior_at_the_reference_values() -> None:
    reference = {
        **{-5: 8.884, -4.5: 8.385, -4: 7.885, -3: 6.887, -2: 5.891, -1: 4.894},
        **{0: 3.893, 1: 2.957, 2: 2.260, 2.5: 2.141, 3: 2.162, 4: 2.336, 5: 2.532},
    }
    gain = ExactPosterior([], []).expected_information_gain(list(reference))
    assert gain.numpy() == pytest.approx(np.array(list(reference.values())), abs=6e-4)
    sinh = ExactPosterior([], [], variant="sinh")
    gain = sinh.expected_information_gain(torch.tensor([[-5.0], [-4.5], [-4.0]]))
    assert gain.numpy() == pytest.approx(np.array([8.79, 8.29, 7.79]), abs=0.01)
