"""The exact posterior, its predictive and its gain, each against something else."""

import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active.tasks.numerical.exact import ExactPosterior, noise_free
from sbi_active.tasks.numerical.exact_evidence import RESPONSES
from sbi_active.tasks.numerical.exact_greedy import (
    greedy_action,
    greedy_design,
    reproduction_error,
)

VARIANTS = tuple(RESPONSES)
ACTIONS = np.arange(-5, 5.5, 0.5)
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
each_history = pytest.mark.parametrize("history", HISTORIES)


def posterior_of(history: str, variant: str = "linear") -> ExactPosterior:
    action = HISTORIES[history]
    noise = np.random.default_rng(0).standard_normal(len(action))
    x = noise_free([THETA_TRUE], action, variant=variant)[0].numpy() + noise
    return ExactPosterior(action, x, variant=variant)


def gain_error(
    posterior: ExactPosterior,
    action: float,
    *,
    truth: ExactPosterior | None = None,
    noise_sd: float = 1.0,
) -> float:
    """Monte Carlo gain less the exact one, in Monte Carlo standard errors.

    Truths come from another posterior, or the noise has another width, in the negative
    controls only.
    """
    rng = np.random.default_rng(1)
    theta = (truth or posterior).sample(1500, seed=rng)
    noise = noise_sd * torch.from_numpy(rng.standard_normal(len(theta)))
    x = noise_free(theta, [action], variant=posterior.variant)[:, 0] + noise
    log_likelihood = -0.5 * noise**2 - 0.5 * np.log(2 * np.pi)
    gain = log_likelihood - posterior.log_predictive(x, action)
    exact = posterior.expected_information_gain([action])[0]
    return float((gain.mean() - exact) / (gain.std() / len(gain) ** 0.5))


def cell_masses(posterior: ExactPosterior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell edges and masses by the midpoint rule; theta_1 > 0 only where g is even.

    The grid covers the samples with a margin: mass they miss is missing from the total.
    """
    theta = posterior.sample(4000, seed=3).numpy()
    if posterior.variant == "square":
        theta = abs(theta)
        theta[:, 1] = posterior.sample(4000, seed=3)[:, 1]
    margin = 0.5 * np.ptp(theta, axis=0)
    lowest = [0.0 if posterior.variant == "square" else -5.0, -5.0]
    low = np.maximum(theta.min(0) - margin, lowest)
    high = np.minimum(theta.max(0) + margin, 5.0)
    edges = np.linspace(low, high, 801)
    centers = 0.5 * (edges[1:] + edges[:-1])
    theta_1, theta_2 = np.meshgrid(*centers.T, indexing="ij")
    cells = np.stack([theta_1.ravel(), theta_2.ravel()], 1)
    area = np.prod(edges[1] - edges[0])
    mass = posterior.log_prob(cells).exp().reshape(800, 800).numpy() * area
    return edges[:, 0], edges[:, 1], mass


# Density and samples


@each_variant
@each_history
def test_density_integrates_to_one(history: str, variant: str) -> None:
    mass = cell_masses(posterior_of(history, variant))[2]
    both_signs = 2 if variant == "square" else 1
    # the midpoint rule; its error is largest where the box cuts the density
    assert both_signs * mass.sum() == pytest.approx(1, abs=3e-4)


@each_variant
@pytest.mark.parametrize("action", [[3.0], [2.0, 5.0], [4.0, 2.5, 3.5]])
def test_evidence_against_prior_samples(action: list[float], variant: str) -> None:
    x = [0.4, -1.0, 2.0][: len(action)]
    theta = np.random.default_rng(4).uniform(-5, 5, (400_000, 2))
    residual = np.array(x) - noise_free(theta, action, variant=variant).numpy()
    likelihood = stats.norm.pdf(residual).prod(1)
    standard_error = likelihood.std() / len(theta) ** 0.5
    evidence = np.exp(ExactPosterior(action, x, variant=variant).log_evidence)
    assert abs(likelihood.mean() - evidence) < 4 * standard_error
    assert standard_error < 0.03 * evidence  # or the check would be blunt


@each_variant
@each_history
def test_samples_follow_the_density(history: str, variant: str) -> None:
    posterior = posterior_of(history, variant)
    edges_1, edges_2, mass = cell_masses(posterior)
    mass = mass / mass.sum()
    theta = posterior.sample(4000, seed=5).numpy()
    if variant == "square":
        positive = theta[:, 0] > 0
        assert abs(positive.mean() - 0.5) < 4 * 0.5 / len(theta) ** 0.5
        theta = theta * np.where(positive, 1.0, -1.0)[:, None] ** [1, 0]
    for edges, marginal, draws in (
        (edges_1, mass.sum(1), theta[:, 0]),
        (edges_2, mass.sum(0), theta[:, 1]),
    ):
        cdf = np.append(0.0, np.cumsum(marginal))
        assert (
            stats.kstest(draws, lambda t, e=edges, c=cdf: np.interp(t, e, c))[1] > 1e-3
        )
    center_1, center_2 = edges_1[1:] + edges_1[:-1], edges_2[1:] + edges_2[:-1]
    center_1, center_2 = 0.5 * center_1, 0.5 * center_2
    mean = np.array([center_1 @ mass.sum(1), center_2 @ mass.sum(0)])
    covariance = (center_1 - mean[0]) @ mass @ (center_2 - mean[1])
    product = (theta - mean).prod(1)
    assert abs(product.mean() - covariance) < 4 * product.std() / len(theta) ** 0.5


@each_variant
def test_no_trials_give_the_prior(variant: str) -> None:
    prior = ExactPosterior(torch.zeros(0, 1), torch.zeros(0, 1), variant=variant)
    assert prior.log_evidence == pytest.approx(0, abs=1e-9)
    expected = torch.tensor([-np.log(100), -np.log(100), -torch.inf, -torch.inf])
    log_prob = prior.log_prob([[0.0, 0.0], [5.0, -5.0], [5.1, 0.0], [0.0, -5.1]])
    torch.testing.assert_close(log_prob, expected.double())
    theta = prior.sample(4000, seed=0)
    assert theta.shape == (4000, 2)
    assert theta.dtype == torch.float64
    for draws in theta.T:
        assert stats.kstest(draws, stats.uniform(-5, 10).cdf)[1] > 1e-3


@pytest.mark.parametrize("action", [0.0, 1e-12, 1e-9])
def test_theta_2_stays_uniform_after_action_zero(action: float) -> None:
    posterior = ExactPosterior([action] * 2, [-60.0, -61.0])
    log_prob = posterior.log_prob([[-3.0, -4.0], [-3.0, 0.0], [-3.0, 4.9]])
    assert log_prob.max() - log_prob.min() < 1e-5
    theta_2 = posterior.sample(4000, seed=0)[:, 1]
    assert stats.kstest(theta_2, stats.uniform(-5, 10).cdf)[1] > 1e-3
    exact = ExactPosterior([0.0, 0.0], [-60.0, -61.0])
    assert posterior.log_evidence == pytest.approx(exact.log_evidence, abs=1e-5)


def test_kinds_and_order_of_trials_do_not_matter() -> None:
    action, x = [-5.0, 0.5, 3.0], [-8946.0, -37.5, 0.25]
    theta = torch.tensor([[-3.0, 1.0], [2.0, 0.0]])
    expected = ExactPosterior(action, x).log_prob(theta)
    for other in (
        ExactPosterior(torch.tensor(action)[:, None], torch.tensor(x)[:, None]),
        ExactPosterior(np.array(action), np.array(x)[:, None]),
        ExactPosterior(action[::-1], x[::-1]),
    ):
        torch.testing.assert_close(other.log_prob(theta), expected)
    assert expected.shape == (2,)
    assert expected.dtype == torch.float64


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_samples_where_the_data_leave_the_box(sign: float) -> None:
    posterior = ExactPosterior([0.0, 5.0], [0.0, sign * 600.0])
    # theta_2 piles up at the edge, its density falling at the rate xi |residual|
    rate = 5 * (600 - 25)
    distance = 5 - sign * posterior.sample(4000, seed=0)[:, 1]
    assert stats.kstest(distance, stats.expon(scale=1 / rate).cdf)[1] > 1e-3


@each_variant
def test_mass_positive(variant: str) -> None:
    assert posterior_of("prior", variant).mass_positive() == pytest.approx(0.5)
    sharp = 0.5 if variant == "square" else 0.0
    assert posterior_of("ridge", variant).mass_positive() == sharp
    posterior = ExactPosterior([2.0], [-4.0], variant=variant)
    mass = posterior.mass_positive()
    positive = (posterior.sample(20_000, seed=0)[:, 0] > 0).double().mean()
    assert abs(positive - mass) < 4 * (mass * (1 - mass) / 20_000) ** 0.5
    assert (mass == 0.5) == (variant == "square")


# Predictive and gain


@each_variant
@each_history
def test_gain_against_monte_carlo(history: str, variant: str) -> None:
    posterior = posterior_of(history, variant)
    for action in (-5.0, 0.0, 3.7):
        assert abs(gain_error(posterior, action)) < 4, action


@each_variant
@pytest.mark.parametrize("action", [-5.0, 0.0, 3.7])
def test_monte_carlo_notices_what_is_wrong(action: float, variant: str) -> None:
    posterior, other = posterior_of("off grid", variant), posterior_of("prior", variant)
    assert abs(gain_error(posterior, action, noise_sd=1.3)) > 4
    assert abs(gain_error(posterior, action, truth=other)) > 4


@each_variant
@each_history
@pytest.mark.parametrize("action", [-0.7, 2.0])
def test_gain_against_the_predictive(history: str, variant: str, action: float) -> None:
    posterior = posterior_of(history, variant)
    x = noise_free(posterior.sample(1000, seed=0), [action], variant=variant)
    margin = 10 + 0.5 * (x.max() - x.min())
    grid = torch.arange(x.min() - margin, x.max() + margin, 0.5, dtype=torch.float64)
    log_density = posterior.log_predictive(grid, action)
    density = log_density.exp()
    assert density.sum() * 0.5 == pytest.approx(1, abs=1e-7)
    entropy = -(density * log_density).sum().item() * 0.5
    gain = posterior.expected_information_gain([action]).item()
    assert gain == pytest.approx(entropy - 0.5 * np.log(2 * np.pi * np.e), abs=2e-5)


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


@pytest.mark.parametrize(
    ("variant", "mean_log_slope"),
    [("linear", 0.0), ("sinh", np.log(2 / np.sinh(2)) + 0.507911)],
)
def test_gain_of_a_steep_action_is_the_entropy_of_g(
    variant: str, mean_log_slope: float
) -> None:
    # E log cosh u = .507911 for u uniform on [0, 2]; x is blurred by 50 in 30,000
    entropy = np.log(10) + mean_log_slope + 8
    prior = ExactPosterior([], [], variant=variant)
    gain = prior.expected_information_gain([-5.0]).item()
    assert gain == pytest.approx(entropy - 0.5 * np.log(2 * np.pi * np.e), abs=1e-3)


def test_gain_of_a_gaussian_posterior() -> None:
    posterior = posterior_of("repeated")  # far inside the box, so a plain Gaussian
    design = np.stack([np.exp(3 - posterior.action), posterior.action], 1)
    new = np.stack([np.exp(3 - ACTIONS), ACTIONS], 1)
    variance = np.einsum("ai,ij,aj->a", new, np.linalg.inv(design.T @ design), new)
    gain = posterior.expected_information_gain(ACTIONS).numpy()
    assert gain == pytest.approx(0.5 * np.log1p(variance), abs=1e-5)


@each_variant
def test_gain_falls_as_an_action_is_repeated(variant: str) -> None:
    gains = [
        ExactPosterior([5.0] * t, [4.0] * t, variant=variant)
        .expected_information_gain([5.0])
        .item()
        for t in (0, 1, 2, 4)
    ]
    # g e^-2 + 5 theta_2 is known to 1 / sqrt(t), its prior flat there
    expected = [0.5 * np.log((t + 1) / t) for t in (1, 2, 4)]
    assert gains[0] > 2.5
    assert gains[1:] == pytest.approx(expected, abs=1e-3)


def test_gain_where_the_data_leave_the_box() -> None:
    for action, x in (([-5.0, 5.0], [-8948.0, 200.0]), ([-5.0], [2e4]), ([0.0], [1e6])):
        gain = ExactPosterior(action, x).expected_information_gain([-5.0, 0.0, 5.0])
        assert ((gain > -1e-4) & (gain < 3)).all()


# Greedy design


def test_greedy_campaigns_at_the_reference_values() -> None:
    campaigns = [greedy_design(THETA_TRUE, ACTIONS, seed=seed) for seed in range(40)]
    action = torch.stack([c.action[:, 0] for c in campaigns])
    assert (action[:, 0] == -5).all()
    assert (action[:, 1] == 5).all()
    log_prob = torch.stack([c.log_prob for c in campaigns]).numpy()
    quartiles = np.percentile(log_prob, [25, 50, 75], axis=0)
    standard_error = 1.253 * (quartiles[2] - quartiles[0]) / 1.349 / 40**0.5
    reference = np.array([4.57, 7.14, 7.41, 7.74])
    assert (abs(quartiles[1] - reference) < 4 * standard_error).all()
    error = torch.stack([c.reproduction_error[-1] for c in campaigns]).numpy()
    reference = np.array([0.39, 0.0076, 0.485])
    assert (abs(error.mean(0) - reference) < 4 * error.std(0) / 40**0.5).all()


@each_variant
def test_greedy_campaign_repeats_itself_and_its_noise(variant: str) -> None:
    def noise(actions: list[float]) -> torch.Tensor:
        campaign = greedy_design(THETA_TRUE, actions, variant=variant, seed=7)
        again = greedy_design(THETA_TRUE, actions, variant=variant, seed=7)
        for one, other in zip(campaign, again, strict=True):
            assert torch.equal(one, other)
        outcome = noise_free([THETA_TRUE], campaign.action, variant=variant)
        return campaign.x[:, 0] - outcome[0]

    torch.testing.assert_close(noise([-3.0, 3.0]), noise([0.0, 5.0]))


def test_greedy_action_breaks_ties_by_seed() -> None:
    prior = ExactPosterior([], [])
    chosen = {greedy_action(prior, [-3.0, 0.0, -3.0], seed=s)[0] for s in range(20)}
    assert chosen == {0, 2}
    index, gain = greedy_action(prior, [[0.0], [-3.0]], seed=0)
    assert index == 1
    assert gain.tolist() == pytest.approx([3.893, 6.887], abs=6e-4)


def test_reproduction_error() -> None:
    theta = torch.tensor([[-3.0, 1.0], [-2.0, 1.0], [-3.0, 3.0]])
    error = reproduction_error(theta, THETA_TRUE, [3.0, 0.0])
    assert error.tolist() == pytest.approx([(0 + 1 + 6) / 3, np.exp(3) / 3])
    mirrored = torch.tensor([[3.0, 1.0]])
    assert reproduction_error(mirrored, THETA_TRUE, [3.0], variant="square") == 0


# Errors


@pytest.mark.parametrize(
    ("action", "x", "variant", "message"),
    [
        (
            [1.0, 2.0],
            [1.0],
            "linear",
            "expected one x an action; got 2 actions and 1 x",
        ),
        (torch.zeros(2, 2), [1.0, 1.0], "linear", r"expected action of shape \(n,\)"),
        (
            [1.0],
            torch.zeros(1, 1, 1),
            "linear",
            r"expected x of shape .*got \(1, 1, 1\)",
        ),
        ([5.5], [1.0], "linear", r"expected actions in \[-5, 5\]; got 5.5"),
        ([1.0], [float("nan")], "linear", "expected finite x"),
        ([1.0], [1.0], "cubic", "linear, sinh, square; got 'cubic'"),
    ],
)
def test_bad_trials(action, x, variant: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExactPosterior(action, x, variant=variant)


def test_bad_parameters() -> None:
    posterior = ExactPosterior([], [])
    with pytest.raises(
        ValueError, match=r"expected theta of shape \(n, 2\); got \(2,\)"
    ):
        posterior.log_prob([0.0, 0.0])
    with pytest.raises(ValueError, match="expected one theta_true"):
        greedy_design(torch.zeros(3, 2), ACTIONS, seed=0)
    with pytest.raises(ValueError, match="linear, sinh, square; got 'Linear'"):
        noise_free([[0.0, 0.0]], [0.0], variant="Linear")


def test_greedy_design_with_given_actions():
    made = greedy_design(THETA_TRUE, [-5, 0, 5], num_rounds=2, chosen=[1, 2], seed=3)
    assert made.action.flatten().tolist() == [0, 5]
    greedy = greedy_design(THETA_TRUE, [-5, 0, 5], num_rounds=2, seed=3)
    assert made.gain[0] < greedy.gain[0]
