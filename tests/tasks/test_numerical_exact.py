"""The exact posterior, its predictive and its gain, each against something else."""

import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active.tasks.numerical.exact import ExactPosterior, noise_free
from sbi_active.tasks.numerical.exact_evidence import RESPONSES

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


# Density and samples


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


# Predictive and gain


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
