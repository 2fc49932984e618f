"""Jumps and noise that few rows do not follow: a belief is right, or has doubts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.actions import BoxActions, DiscreteActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.inference import RefinementOptions
from sbi_active.inference.emulation.checks import _of_few
from sbi_active.inference.emulation.emulator import EmulatedLikelihood, emulated
from sbi_active.inference.emulation.pool import TrialRows
from sbi_active.inference.emulation.refining import refine
from sbi_active.inference.emulation.regression import Regression
from sbi_active.inference.emulation.solving import around, whole_space
from sbi_active.inference.emulation.stages import FEW_ROWS, largest_error
from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.simulation import GaussianNoise, SimulatorModel

EDGE = -0.4
FEW = RefinementOptions(num_histories=400, num_effective=50)


def belief_of(response, seed, num=300):
    """Return the belief of two trials, each a slope and a response beside it."""

    def fn(theta, xi):
        return theta[:, :1] * xi + 3 * response(theta[:, 1:] - EDGE)

    simulator = SimulatorModel(fn, noise=0.1)
    prior = BoxUniform(-torch.ones(2), torch.ones(2))
    options = CampaignOptions(max_simulations=num, planned_trials=2, refinement=FEW)
    given = {"options": options, "seed": seed}
    campaign = Campaign(simulator, prior, BoxActions([0.5], [1.5]), **given)
    truth = torch.tensor([[0.3, EDGE + 0.05]])
    for xi in (0.7, 1.3):
        action = torch.tensor([[xi]])
        campaign.attach(action[0], fn(truth, action)[0])
    return campaign.update()


def test_a_jump_is_followed_or_said_to_be_missed():
    """Beyond the jump the second parameter changes nothing: it may be anywhere."""
    belief = belief_of(lambda off: (off > 0).float(), 0, 160)
    middle, sd = 0.5 * (1 + EDGE), (1 - EDGE) / 12**0.5
    is_right = abs(float(belief.mean[1]) - middle) < 0.3 * sd
    assert is_right or not belief.diagnostics.trustworthy


@pytest.mark.parametrize("seed", range(4))
def test_a_steep_response_that_rows_resolve_is_trusted(seed):
    """Half as wide it is resolved or not by rounding."""
    belief = belief_of(lambda off: torch.sigmoid(off / 0.2), seed)
    assert belief.diagnostics.trustworthy


def rows_of(function):
    """Return rows of a trial whose outcome is 0."""
    z = np.linspace(-1, 1, 31)[:, None] ** 3
    x, none = function(z), np.zeros((0, 2), dtype=int)
    agrees, used = np.ones(len(z), dtype=bool), np.ones(1, dtype=bool)
    return TrialRows(torch.zeros(1), z, x, np.zeros(1), used, agrees, none)


def test_the_error_of_a_learned_likelihood_is_what_simulations_say():
    prior = BoxUniform(-torch.ones(1), torch.ones(1))
    coordinates = PriorCoordinates(prior, np.random.default_rng(0))
    rows = rows_of(lambda z: z)
    noise = GaussianNoise(0.1)
    known = {"noise": noise, "x_shape": (1,)}
    learned = emulated(coordinates, whole_space(1), [rows], **known)
    fit = learned_fit(learned, np.random.default_rng(0))
    z = rows.z[11:20]  # within a deviation or two
    assert largest_error([fit], learned, [rows], z) < 0.01
    jumps = replace(rows, x=np.where(rows.z > 0, 5.0, rows.x))
    assert largest_error([fit], learned, [jumps], z) > 3
    lost = replace(rows, agrees=rows.z[:, 0] < 0)
    assert largest_error([fit], learned, [lost], z) > 3
    nothing = replace(rows, agrees=np.zeros(len(rows.z), dtype=bool))
    assert largest_error([fit], learned, [nothing], z) == np.inf
    assert largest_error([fit], learned, [rows], z + 1e-3) == np.inf
    for off, holds in ((0.5, True), (3.0, False)):
        doubts = _of_few(learned, FEW_ROWS, off)
        assert doubts["likelihood_followed"][0] is holds


# Noise that a learned likelihood does not follow, and beliefs that say so


PRIOR = BoxUniform(-2 * torch.ones(1), 2 * torch.ones(1))


def noisy(draw):
    return lambda theta, xi: theta * xi + 0.3 * draw(theta)


#: Draws of noise, and whether it is normal.
NOISES = [
    (torch.randn_like, True),
    (lambda t: -torch.rand_like(t).log(), False),  # exponential
    (lambda t: torch.randn_like(t).sign(), False),
    (lambda t: torch.exp(1.5 * t) * torch.randn_like(t), False),
]


@pytest.mark.parametrize(("draw", "holds"), NOISES)
def test_few_simulations_tell_noise_that_is_not_normal(draw, holds):
    options = CampaignOptions(max_simulations=500, planned_trials=3, refinement=FEW)
    actions = DiscreteActions([1.0, 2.0])
    campaign = Campaign(noisy(draw), PRIOR, actions, seed=0, options=options)
    torch.manual_seed(0)
    for xi in (1.0, 2.0, 2.0):
        x = noisy(draw)(torch.tensor([[0.5]]), torch.tensor([[xi]]))
        campaign.tell(x[0], action=[xi])
    assert campaign.update().diagnostics.trustworthy is holds


@pytest.mark.parametrize(("slope", "holds"), [(0.0, True), (1.0, False)])
def test_a_scale_that_depends_on_the_parameters_is_a_doubt(slope, holds):
    """Its mean says nothing, so that the belief would be the prior."""

    def simulator(theta, xi):
        return 0.3 * theta + torch.exp(slope * theta) * torch.randn_like(theta)

    action, x = torch.ones(3, 1), torch.tensor([[0.1], [-0.1], [0.05]])
    torch.manual_seed(0)
    belief = refine(simulator, PRIOR, action, x, seed=0)
    found = belief.diagnostics
    assert found.assumptions["even_noise"].holds is holds
    assert found.trustworthy is holds


@pytest.mark.parametrize(("misfit", "holds"), [(1.5, True), (1.2, False)])
def test_of_few_rows_the_loop_decides_how_much_misfit_is_a_doubt(misfit, holds):
    z = np.linspace(-1, 1, 60)[:, None]
    noisy = z + 0.1 * np.random.default_rng(0).standard_normal(z.shape)
    region, none = whole_space(1), np.zeros((0, 2), dtype=int)
    fit = Regression.fit(region, z, noisy, none, np.zeros(1, dtype=int), np.zeros(1))
    coordinates = PriorCoordinates(PRIOR, np.random.default_rng(0))
    part = replace(fit, excess=1.3)
    learned = EmulatedLikelihood(coordinates, region, (part,), ((0,),))
    settings = replace(FEW_ROWS, misfit=misfit)
    assert _of_few(learned, settings, 0.0)["no_misfit"][0] is holds


# Regressions, and what few simulations cost a belief


NUM = 400


def regress(curve, *, noise: float = 0.1, q: int = 3, num: int = NUM, seed: int = 0):
    """Return the regression of q numbers of two parameters, and their weights."""
    rng = np.random.default_rng(seed)
    weight = np.random.default_rng(q).standard_normal((2, q))
    z = rng.uniform(-1, 1, (num, 2))
    z = np.concatenate([z, z[: num // 5]])
    x = curve(z) @ weight + noise * rng.standard_normal((len(z), q))
    pairs = np.stack([np.arange(num // 5), num + np.arange(num // 5)], 1)
    trial, observed = np.zeros(q, dtype=int), np.zeros(q)
    return Regression.fit(whole_space(2), z, x, pairs, trial, observed), weight


@pytest.mark.parametrize("q", [1, 3, 12])
def test_likelihood_of_a_linear_model(q: int):
    fit, weight = regress(lambda z: z, q=q)
    z = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2)) * 0.1
    # The observation is the origin, since outcomes are given less the observed ones.
    square = ((z @ weight) ** 2).sum(1) / 0.1**2
    exact = -0.5 * square - 0.5 * q * np.log(2 * np.pi * 0.1**2)
    # q variances, each from some 400 residuals, and 3 coefficients a outcome.
    error = np.sqrt(q / 2 / NUM) + np.sqrt(3 * square.max() / NUM)
    assert abs(fit.log_likelihood(z) - exact).max() < 4 * error
    assert not fit.has_misfit
    assert fit.caution() == 1


def test_misfit_is_told_from_noise():
    # No polynomial or smooth wave follows a step.
    fit, _ = regress(lambda z: np.sign(z - 0.1))
    assert fit.has_misfit
    assert fit.ratio > 3
    assert fit.caution() >= 2


@pytest.mark.parametrize("num", [100, 400])
def test_expected_error_is_the_mean_divergence(num: int):
    expected, actual = [], []
    for seed in range(20):
        fit, weight = regress(lambda z: z, noise=1.0, q=4, num=num, seed=seed)
        rng = np.random.default_rng(1_000 + seed)
        precision = weight @ weight.T + 10 * np.eye(2)
        factor = np.linalg.cholesky(np.linalg.inv(precision))
        draws = rng.standard_normal((2_000, 2)) @ factor.T
        expected.append(fit.error(draws, rng))
        # KL(exact || belief), the normalizer by importance sampling from the exact.
        ratio = fit.log_likelihood(draws) + 0.5 * ((draws @ weight) ** 2).sum(1)
        top = ratio.max()
        actual.append(np.log(np.exp(ratio - top).mean()) + top - ratio.mean())
    error = np.std(actual) / len(actual) ** 0.5
    assert np.mean(expected) == pytest.approx(np.mean(actual), rel=0.3, abs=3 * error)


def test_distant_simulations_count_where_the_response_is_simple():
    rng = np.random.default_rng(0)
    near, far = 0.1 * rng.standard_normal((200, 1)), rng.uniform(-1, 1, (200, 1))
    z, none = np.concatenate([near, far]), np.zeros((0, 2), dtype=int)
    region = around(0.03 * rng.standard_normal((500, 1)))
    reaches = {}
    for curve in (lambda z: z, lambda z: np.sign(z) * (np.abs(z) > 0.4) + z):
        x = curve(z) + 0.05 * rng.standard_normal(z.shape)
        fit = Regression.fit(region, z, x, none, np.zeros(1, dtype=int), np.zeros(1))
        reaches[curve] = fit.basis.reach * 0.03
    near, far = sorted(reaches.values())
    assert list(reaches.values()) == [far, near]
    assert near < 0.6 < far
