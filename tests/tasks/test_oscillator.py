"""The oscillator against its differential equation, its reference against itself.

Tolerances are multiples of stated standard errors; seeds are fixed.
"""

import math

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from sbi_active.tasks.oscillator import reference as reference_module
from sbi_active.tasks.oscillator.model import (
    ACTION_HIGH,
    ACTION_LOW,
    ACTIONS,
    NOISE_SD,
    PRIOR_HIGH,
    PRIOR_LOW,
    SAMPLE_TIMES,
    SENSOR_RANGE,
    mean,
)
from sbi_active.tasks.oscillator.reference import OscillatorReference


def uniform(n: int, low: Tensor, high: Tensor, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(n, len(low), generator=generator, dtype=torch.float64)
    return low + (high.double() - low.double()) * u


def history(num_trials: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return a true theta, random actions of the grid and outcomes."""
    theta = uniform(1, PRIOR_LOW, PRIOR_HIGH, seed)
    generator = torch.Generator().manual_seed(1000 + seed)
    index = torch.randint(len(ACTIONS), (num_trials,), generator=generator)
    action = ACTIONS[index].double()
    noise = torch.randn(num_trials, 6, generator=generator, dtype=torch.float64)
    return theta, action, mean(theta, action) + NOISE_SD * noise


# ------------------------------------------------------------------ the model


def test_mean_solves_the_equation_of_motion():
    theta = uniform(6, PRIOR_LOW, PRIOR_HIGH, 0)
    action = uniform(6, ACTION_LOW, ACTION_HIGH, 1)
    theta[0, 3] = 0.0
    action[1, 1] = theta[1, 0]  # at resonance
    for row, xi, readings in zip(theta, action, mean(theta, action), strict=True):
        omega_0, zeta, gain, tau = row.tolist()
        amplitude, omega = xi.tolist()

        def motion(t, state, omega_0=omega_0, zeta=zeta, gain=gain, tau=tau,
                   amplitude=amplitude, omega=omega):  # fmt: skip
            y, v = state
            force = gain * omega_0**2 * amplitude * math.sin(omega * (t - tau))
            return [v, force - 2 * zeta * omega_0 * v - omega_0**2 * y]

        solution = solve_ivp(
            motion,
            (tau, 4.0),
            [0.0, 0.0],
            method="DOP853",
            t_eval=SAMPLE_TIMES.double().numpy(),
            rtol=1e-10,
            atol=1e-12,
        )
        expected = SENSOR_RANGE * np.tanh(solution.y[0] / SENSOR_RANGE)
        np.testing.assert_allclose(readings, expected, atol=1e-7)


# -------------------------------------------------------------- the posterior


def evidence_by_prior(
    action: Tensor, x: Tensor, noise_sd: float = NOISE_SD
) -> tuple[float, float]:
    """Log evidence and standard error from half a million draws of the prior."""
    log_likelihood = []
    for block in range(5):
        theta = uniform(100_000, PRIOR_LOW, PRIOR_HIGH, 50 + block)
        total = torch.zeros(len(theta), dtype=torch.float64)
        for xi, row in zip(action, x, strict=True):
            density = torch.distributions.Normal(mean(theta, xi[None]), noise_sd)
            total += density.log_prob(row).sum(-1)
        log_likelihood.append(total)
    weight = torch.cat(log_likelihood)
    top = weight.max()
    weight = (weight - top).exp()
    error = weight.std() / weight.mean() / math.sqrt(len(weight))
    return float(top + weight.mean().log()), float(error)


def test_evidence_matches_sampling_from_the_prior():
    _, action, x = history(2, seed=1)
    posterior = OscillatorReference(action, x)
    expected, error = evidence_by_prior(action, x)
    error = math.hypot(error, posterior.log_evidence_se)
    assert error < 0.1
    assert abs(posterior.log_evidence - expected) < 4 * error

    # negative control: the check sees a noise that is a tenth too large
    wrong = OscillatorReference(action, x, noise_sd=1.1 * NOISE_SD)
    assert abs(wrong.log_evidence - expected) > 4 * error


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
    eye = torch.eye(4, dtype=torch.float64)
    first = torch.tensor([[0.05, 1.0]]).double()
    x = first[:, :1] * (torch.tensor([[0.5, -0.3, 0.2, 1.0]]).double() @ DESIGN)

    precision = eye + 0.05**2 * information
    posterior = OscillatorReference(first, x)
    gain, error = posterior.expected_information_gain(
        action, num_outer=2_000, num_inner=10_000
    )
    after = precision + action[:, :1, None] ** 2 * information
    exact = 0.5 * (torch.logdet(after) - torch.logdet(precision))
    assert bool((error < 0.05).all())
    assert bool(((gain - exact).abs() < 4 * error + 0.01).all())

    covariance = first[0, 0] ** 2 * DESIGN.T @ DESIGN + NOISE_SD**2 * torch.eye(6)
    marginal = torch.distributions.MultivariateNormal(
        torch.zeros(6).double(), covariance
    )
    exact = float(marginal.log_prob(x))
    assert abs(posterior.log_evidence - exact) < 4 * posterior.log_evidence_se
