"""The oscillator against its differential equation, its reference against itself.

Tolerances are multiples of stated standard errors; seeds are fixed.
"""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.stats import chi2, kstest
from torch import Tensor

from sbi_active.tasks.oscillator import nested
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
from sbi_active.tasks.oscillator.nested import NestedGain
from sbi_active.tasks.oscillator.reference import OscillatorReference

LOG_VOLUME = float((PRIOR_HIGH - PRIOR_LOW).double().log().sum())


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


@pytest.fixture(scope="module")
def posterior() -> OscillatorReference:
    _, action, x = history(3, seed=3)
    return OscillatorReference(action, x)


# ------------------------------------------------------------------ the model


def test_mean_solves_the_equation_of_motion():
    theta = uniform(12, PRIOR_LOW, PRIOR_HIGH, 0)
    action = uniform(12, ACTION_LOW, ACTION_HIGH, 1)
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
            t_eval=SAMPLE_TIMES.double().numpy(),
            rtol=1e-10,
            atol=1e-12,
        )
        expected = SENSOR_RANGE * np.tanh(solution.y[0] / SENSOR_RANGE)
        np.testing.assert_allclose(readings, expected, atol=1e-7)


def test_mean_starts_at_rest_until_the_delay():
    theta = torch.tensor([[4.0, 0.1, 1.0, 0.6]])  # beyond the prior: 0.6 > first sample
    assert mean(theta, torch.tensor([[1.0, 5.0]]))[0, 0] == 0


def test_mean_gradient_matches_finite_differences():
    theta = uniform(20, PRIOR_LOW, PRIOR_HIGH, 2).requires_grad_()
    action = uniform(20, ACTION_LOW, ACTION_HIGH, 3).requires_grad_()
    assert torch.autograd.gradcheck(mean, (theta, action))


def test_mean_gradient_is_finite_everywhere_in_the_box():
    corners = torch.cartesian_prod(*torch.stack([PRIOR_LOW, PRIOR_HIGH], 1))
    theta = corners.repeat_interleave(len(ACTIONS), 0).requires_grad_()
    readings = mean(theta, ACTIONS.repeat(len(corners), 1))
    (gradient,) = torch.autograd.grad(readings.square().sum(), theta)
    assert gradient.isfinite().all()
    assert gradient.abs().amax(0).min() > 0  # every parameter matters


def test_mean_keeps_the_dtype_and_broadcasts():
    theta = uniform(5, PRIOR_LOW, PRIOR_HIGH, 4)
    assert mean(theta.float(), ACTIONS[:5]).dtype == torch.float32
    pairs = mean(theta[:, None], ACTIONS[:3])
    assert pairs.shape == (5, 3, 6)
    torch.testing.assert_close(pairs[:, 1], mean(theta, ACTIONS[1:2].expand(5, 2)))


def test_actions_lie_in_the_box():
    assert ACTIONS.shape == (35, 2)
    assert bool(((ACTIONS >= ACTION_LOW) & (ACTIONS <= ACTION_HIGH)).all())


@pytest.mark.parametrize("shapes", [((4,), (1, 2)), ((3, 3), (3, 2)), ((3, 4), (3, 1))])
def test_mean_rejects_wrong_shapes(shapes):
    with pytest.raises(ValueError, match=r"expected theta \(n, 4\)"):
        mean(torch.ones(shapes[0]), torch.ones(shapes[1]))


# -------------------------------------------------------------- the posterior


def evidence_by_prior(
    action: Tensor, x: Tensor, noise_sd: float = NOISE_SD
) -> tuple[float, float]:
    """Log evidence and standard error from a million draws of the prior."""
    log_likelihood = []
    for block in range(10):
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


def test_density_integrates_to_one(posterior):
    """By importance sampling from one wide Student-t in the logits of the box."""
    theta = posterior.sample(4_000, seed=0)
    low, high = PRIOR_LOW.double(), PRIOR_HIGH.double()
    logit = torch.logit((theta - low) / (high - low))
    proposal = torch.distributions.MultivariateNormal(
        torch.zeros(4).double(), 2 * torch.cov(logit.T)
    )
    torch_generator = torch.Generator().manual_seed(1)
    n = 100_000
    z = torch.randn(n, 4, generator=torch_generator, dtype=torch.float64)
    g = torch.randn(n, 5, generator=torch_generator, dtype=torch.float64)
    stretch = (g.square().sum(-1) / 5).rsqrt()[:, None]
    offset = stretch * (z @ proposal.scale_tril.T)
    distance = z.square().sum(-1) * stretch[:, 0] ** 2
    log_proposal = (
        math.lgamma(4.5) - math.lgamma(2.5) - 2 * math.log(5 * math.pi)
        - proposal.scale_tril.diagonal().log().sum()
        - 4.5 * torch.log1p(distance / 5)
    )  # fmt: skip
    sigmoid = torch.sigmoid(logit.mean(0) + offset)
    log_slope = ((high - low) * sigmoid * (1 - sigmoid)).log().sum(-1)
    log_weight = (
        posterior.log_prob(low + (high - low) * sigmoid) + log_slope - log_proposal
    )
    weight = log_weight.exp()
    error = math.hypot(
        float(weight.std()) / math.sqrt(n), float(posterior.log_evidence_se)
    )
    assert error < 0.05
    assert abs(float(weight.mean()) - 1) < 4 * error


def test_seeds_agree_within_the_stated_error():
    _, action, x = history(4, seed=5)
    runs = [OscillatorReference(action, x, seed=s) for s in range(4)]
    values = np.array([r.log_evidence for r in runs])
    errors = np.array([r.log_evidence_se for r in runs])
    assert errors.max() < 0.02
    statistic = float((((values - values.mean()) / errors) ** 2).sum())
    assert statistic < chi2.ppf(0.999, len(runs) - 1)


def test_samples_follow_log_prob(posterior):
    """Moments of draws against self-normalised moments of the density."""
    theta = posterior.sample(10_000, seed=2)
    assert bool(posterior.log_prob(theta).isfinite().all())
    # an independent self-normalised sampler: a widened copy of the draws
    center, factor = theta.mean(0), torch.linalg.cholesky(2.0 * torch.cov(theta.T))
    generator = torch.Generator().manual_seed(3)
    z = torch.randn(200_000, 4, generator=generator, dtype=torch.float64)
    proposed = center + z @ factor.T
    weight = (posterior.log_prob(proposed) + 0.5 * z.square().sum(-1)).softmax(0)
    effective = 1 / weight.square().sum()
    assert effective > 2_000
    for power in (1, 2):
        direct = ((theta - center) / theta.std(0)) ** power
        other = ((proposed - center) / theta.std(0)) ** power
        expected = weight @ other
        spread = weight @ (other - expected).square()
        error = (direct.var(0) / len(direct) + spread / effective).sqrt()
        assert bool(((direct.mean(0) - expected).abs() < 4 * error + 0.005).all())


def test_samples_are_reproducible(posterior):
    torch.testing.assert_close(
        posterior.sample(50, seed=7), posterior.sample(50, seed=7)
    )
    assert not bool(
        (posterior.sample(50, seed=7) == posterior.sample(50, seed=8)).any()
    )


def test_no_trials_give_the_prior():
    prior = OscillatorReference(torch.zeros(0, 2), torch.zeros(0, 6))
    theta = prior.sample(2_000, seed=0)
    torch.testing.assert_close(
        prior.log_prob(theta), torch.full((2_000,), -LOG_VOLUME).double()
    )
    unit = ((theta - PRIOR_LOW) / (PRIOR_HIGH - PRIOR_LOW)).numpy()
    assert min(kstest(column, "uniform").pvalue for column in unit.T) > 1e-3
    assert prior.log_evidence == 0


def test_density_is_zero_outside_the_box(posterior):
    theta = posterior.sample(1, seed=0).repeat(2, 1)
    theta[1, 3] = -0.01
    assert posterior.log_prob(theta).isfinite().tolist() == [True, False]


@pytest.mark.parametrize(
    ("action", "x", "message"),
    [
        ([[1.0]], [[0.0] * 6], r"action of shape \(n, 2\); got \(1, 1\)"),
        ([[1.0, 2.0]], [[0.0] * 5], r"x of shape \(n, 6\); got \(1, 5\)"),
        ([[1.0, 2.0]] * 2, [[0.0] * 6], "one x per action; got 2 actions and 1 x"),
        ([[1.0, 2.0]], [[math.nan] * 6], "finite x"),
    ],
)
def test_reference_rejects_wrong_trials(action, x, message):
    with pytest.raises(ValueError, match=message):
        OscillatorReference(action, x)


def test_log_prob_rejects_wrong_theta(posterior):
    with pytest.raises(ValueError, match=r"theta of shape \(n, 4\); got \(4,\)"):
        posterior.log_prob(torch.ones(4))


def rank_statistic(num_histories: int, noise_sd: float) -> float:
    """Chi-square of the ranks of the true theta in 8 bins, the largest of the four.

    Ranks of one parameter are independent over histories; those of the four are not.
    """
    bins = []
    for seed in range(num_histories):
        theta, action, x = history(1 + seed % 4, seed=100 + seed)
        posterior = OscillatorReference(
            action, x, seed=seed, num_particles=5_000, noise_sd=noise_sd
        )
        below = (posterior.sample(399, seed=seed) < theta).sum(0)
        bins.append(below * 8 // 400)
    counts = torch.stack([torch.bincount(b, minlength=8) for b in torch.stack(bins, 1)])
    expected = num_histories / 8
    return float(((counts - expected) ** 2 / expected).sum(-1).max())


@pytest.mark.slow
def test_true_theta_ranks_uniformly():
    limit = chi2.ppf(1 - 0.001 / 4, 7)
    assert rank_statistic(40, NOISE_SD) < limit
    # negative control: a belief too sure of itself, from a noise five times too small
    assert rank_statistic(40, NOISE_SD / 5) > limit


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
    r"""EIG = log det(I + A^2 D D^T / sd^2) / 2, with and without a first trial."""
    monkeypatch.setattr(reference_module, "mean", linear_mean)
    action = torch.tensor([[0.01, 1.0], [0.05, 1.0], [0.3, 1.0]]).double()
    information = DESIGN @ DESIGN.T / NOISE_SD**2
    eye = torch.eye(4, dtype=torch.float64)
    first = torch.tensor([[0.05, 1.0]]).double()
    x = first[:, :1] * (torch.tensor([[0.5, -0.3, 0.2, 1.0]]).double() @ DESIGN)

    for trials, precision in (
        (([], []), eye),
        ((first, x), eye + 0.05**2 * information),
    ):
        posterior = OscillatorReference(*trials)
        gain, error = posterior.expected_information_gain(action)
        after = precision + action[:, :1, None] ** 2 * information
        exact = 0.5 * (torch.logdet(after) - torch.logdet(precision))
        assert bool((error < 0.05).all())
        assert bool(((gain - exact).abs() < 4 * error + 0.01).all())

    covariance = first[0, 0] ** 2 * DESIGN.T @ DESIGN + NOISE_SD**2 * torch.eye(6)
    marginal = torch.distributions.MultivariateNormal(
        torch.zeros(6).double(), covariance
    )
    exact = float(marginal.log_prob(x))
    posterior = OscillatorReference(first, x)
    assert abs(posterior.log_evidence - exact) < 4 * posterior.log_evidence_se


def test_gain_lies_between_contrastive_bounds():
    """sPCE below, sNMC above (Foster et al. 2020), from the prior alone."""
    action = ACTIONS[[2, 9, 16]].double()
    prior = OscillatorReference([], [])
    gain, error = prior.expected_information_gain(action)
    n, m = 400, 20_000
    contrast = uniform(m, PRIOR_LOW, PRIOR_HIGH, 20)
    truth = uniform(n, PRIOR_LOW, PRIOR_HIGH, 21)
    noise = torch.randn(
        n, 6, generator=torch.Generator().manual_seed(22), dtype=torch.float64
    )
    for k, xi in enumerate(action):
        x = mean(truth, xi[None]) + NOISE_SD * noise
        distance = torch.cdist(x, mean(contrast, xi[None])) / NOISE_SD
        log_other = -0.5 * distance.square()
        log_self = -0.5 * noise.square().sum(-1)
        everyone = torch.cat([log_self[:, None], log_other], 1)
        lower = log_self - everyone.logsumexp(-1) + math.log(m + 1)
        upper = log_self - log_other.logsumexp(-1) + math.log(m)
        slack = 4 * math.hypot(float(upper.std()) / math.sqrt(n), float(error[k]))
        assert float(upper.mean() - lower.mean()) < 1.0
        assert lower.mean() - slack < gain[k] < upper.mean() + slack


def test_more_inner_draws_do_not_change_the_gain():
    """Same outer draws, so that only the inner ones differ."""
    action = ACTIONS[[16, 24]].double()
    prior = OscillatorReference([], [])
    gain, _, bias = NestedGain(prior).estimate(action, 300, 2_000, 0)
    assert bool((bias < 0.1).all())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nested, "NUM_LOCAL", 1024)
        more, _, less_bias = NestedGain(prior).estimate(action, 300, 2_000, 0)
    assert bool((less_bias < bias).all())
    assert bool(((gain - more).abs() < 0.05).all())


def test_gain_follows_resonance_and_falls_with_noise():
    action = torch.tensor([[0.25, 1.0], [0.25, 5.0], [0.25, 13.0]])
    gain, error = OscillatorReference([], []).expected_information_gain(
        action, num_outer=500
    )
    assert gain[1] - gain[0] > 5 * error.max()
    assert gain[1] - gain[2] > 5 * error.max()
    noisy, _ = OscillatorReference([], [], noise_sd=0.5).expected_information_gain(
        action, num_outer=500
    )
    assert bool((noisy < gain - 0.5).all())


def test_repeating_a_trial_gains_less(posterior):
    _, action, _ = history(3, seed=3)
    first, _ = OscillatorReference([], []).expected_information_gain(
        action, num_outer=300
    )
    again, error = posterior.expected_information_gain(action, num_outer=300)
    assert bool((again < first + 4 * error).all())
    assert bool((again > -4 * error).all())
