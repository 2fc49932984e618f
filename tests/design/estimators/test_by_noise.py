"""Entropy differences and nested Monte Carlo against closed forms and references.

Tolerances are four standard errors and a stated bound of the bias. That of nearest
neighbors is of order (k / n)^(2 / d) at the edges of the density.
"""

import math

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.design import EntropyGain, InformationGainDesigner, NestedGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.emulator import MeanEmulator, emulated
from sbi_active.design.sampler import CandidateSampler
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.simulation.workers.settings import IN_PROCESS
from sbi_active.tasks.oscillator import model
from sbi_active.tasks.oscillator.reference import OscillatorReference
from tests.linear_gaussian import PRIOR, candidates, information

BIAS = 0.06  # bound for d = 2 and n = 2000, k = 4, under gains up to 1.6 nats
ACTIONS = torch.tensor([[0.0], [0.5], [1.0], [2.0]])


def declared(n=2_000, actions=ACTIONS, declared_sd=1.0):
    return candidates(actions, n, declared=declared_sd)


def replicated(noise=torch.randn_like):
    return candidates(ACTIONS, 2_000, noise=noise, pairs=True)


def distance(simulations, exact):
    gain = EntropyGain()(None, simulations, PRIOR)
    error = gain.std(1) / gain.shape[1] ** 0.5
    return (gain.mean(1) - exact).abs() - 4 * error


@pytest.mark.parametrize("simulations", [declared, replicated])
def test_the_closed_form(simulations):
    assert (distance(simulations(), information(ACTIONS)) < BIAS).all()


def test_a_wrong_declaration_is_wrong():
    """Negative control: half the noise doubles what x seems to tell."""
    wrong = distance(declared(declared_sd=0.5), information(ACTIONS))
    assert (wrong > BIAS).all()


def test_scales_and_correlation_do_not_matter():
    rows = declared()
    assert rows.mean is not None
    turn = torch.tensor([[1e4, 0.0], [9e3, 1e-2]])
    again = rows.mean + torch.randn_like(rows.x)
    parts = {"x": rows.x @ turn, "mean": rows.mean @ turn, "replicate": again @ turn}
    turned = CandidateSimulations(rows.theta, rows.action, **parts)
    assert (distance(turned, information(ACTIONS)) < BIAS).all()


def test_large_information_does_not_saturate():
    actions = torch.tensor([[1e3], [1e4]])  # 13.8 and 18.4 nats
    assert (distance(declared(actions=actions), information(actions)) < BIAS).all()


def two_sided(theta):
    return torch.distributions.Laplace(0.0, 1.0).sample(theta.shape)


def varying(theta):
    return torch.exp(0.3 * theta) * torch.randn_like(theta)


@pytest.mark.parametrize("noise", [two_sided, varying])
def test_noise_that_is_not_gaussian_is_noticed(noise):
    assert EntropyGain().problems(replicated()) == []
    assert EntropyGain().problems(declared()) == []
    (problem,) = EntropyGain().problems(replicated(noise=noise))
    assert problem.startswith("noise is not Gaussian")


# Nested Monte Carlo, of few simulations with an emulator


LOCAL = 0.05  # bias of 16 local draws, l


def estimate(simulations, belief=PRIOR, **options):
    gain = NestedGain(**options)(None, simulations, belief)
    return gain.mean(1), gain.std(1) / gain.shape[1] ** 0.5


def oscillator(n, index, seed=0):
    torch.manual_seed(seed)
    prior = BoxUniform(model.PRIOR_LOW, model.PRIOR_HIGH)
    theta = prior.sample((n,))
    action = model.ACTIONS[index]
    mean = model.mean(theta[:, None], action).transpose(0, 1)
    noise = GaussianNoise(model.NOISE_SD)
    return CandidateSimulations(theta, action, noise.sample(mean), mean, noise), prior


def test_nested_monte_carlo_has_the_closed_form_and_a_wrong_declaration_none():
    actions = torch.tensor([[0.0], [0.5], [2.0], [20.0], [500.0]])
    gain, error = estimate(declared(n=400, actions=actions))
    assert ((gain - information(actions)).abs() < 4 * error + LOCAL).all()
    assert float(gain[0].abs()) < 4 * float(error[0]) + 0.01
    gain, error = estimate(declared(n=400, declared_sd=0.5))
    wrong = (gain - information(ACTIONS)).abs() > 4 * error + LOCAL
    assert wrong.tolist() == [False, True, True, True]  # where x tells anything


def test_six_numbers_that_four_parameters_make():
    """Gains of .3 to 7.6 nats; the emulator bends where the sensor saturates."""
    index = torch.tensor([6, 16, 23, 33])
    rows, prior = oscillator(400, index)
    assert NestedGain().problems(rows) == []
    assert not NestedGain().needs_slopes(rows)
    gain, error = estimate(rows, prior)
    exact, exact_error = OscillatorReference([], []).expected_information_gain(
        model.ACTIONS[index], num_outer=200, num_inner=20_000
    )
    error = (error**2 + exact_error**2).sqrt()
    assert ((gain - exact).abs() < 3 * error + 0.1).all()
    assert ((gain - exact).abs() < 0.5).all()
    # nearest neighbors in six dimensions do not do it
    coarse = EntropyGain()(None, rows, prior).mean(1)
    assert (coarse - exact).abs().max() > 1.0


SD = 0.003


def shear(theta, action):
    rough = 3 * torch.sin(20 * theta[:, :1])
    return torch.cat([theta[:, :1], theta[:, 1:] + rough], 1)


SHEAR = SimulatorModel(shear, noise=SD)


def test_where_the_emulator_misses_slopes_of_the_simulator_count():
    """A rough shear keeps volumes: 11.6 nats; without slopes they were thousands."""
    action = torch.zeros(1, 1)
    none = torch.empty(0, 1)
    sampler = CandidateSampler(SHEAR, PRIOR, action, 0, IN_PROCESS, 200, True, none)
    rows = sampler.draw(300, action)
    assert NestedGain().needs_slopes(rows)
    sloped = sampler.add_slopes(rows)
    assert sampler.num_drawn == 300 + 2 * 64
    gain, error = estimate(sloped)
    exact = -2 * math.log(SD)
    assert abs(float(gain) - exact) < 3 * float(error) + LOCAL
    assert float(error) < 0.3
    assert abs(float(estimate(rows)[0]) - exact) > 3 * float(error)  # negative control
    assert "slopes of the simulator" in NestedGain().remarks(sloped)[-1]


def test_slopes_count_once_for_each_outcome():
    """A second look halves the variance: log 2, where both outcomes need slopes."""
    designer = InformationGainDesigner([0.0], num_samples=600, estimator="nested")
    known = {"belief": PRIOR, "pending": torch.zeros(1, 1), "seed": 0}
    design = designer.select(None, SHEAR, **known)
    gain, error = design.expected_information_gain, design.standard_error
    assert "slopes of the simulator" in design.notes[0]
    assert abs(float(gain) - math.log(2)) < 3 * float(error) + LOCAL
    assert float(error) < 0.1


def test_noise_that_is_not_declared_is_learned():
    rows, prior = oscillator(200, torch.tensor([6, 23]))
    assert rows.mean is not None
    again = rows.noise.sample(rows.mean)
    pairs = CandidateSimulations(rows.theta, rows.action, rows.x, replicate=again)
    assert NestedGain().problems(pairs) == []
    declared_gain, error = estimate(rows, prior)
    learned, _ = estimate(pairs, prior)
    assert ((learned - declared_gain).abs() < 3 * error + 0.2).all()
    square = 2 * emulated(pairs).emulator.error.square().mean(0)
    assert 0.9 < float(square.median()) < 1.5


def test_outcomes_that_cannot_be_smoothed_are_noticed():
    torch.manual_seed(0)
    theta = PRIOR.sample((200,))
    rough = 1e3 * torch.sin(1e3 * theta).repeat(1, 2)[None]
    x, again = (rough + torch.randn_like(rough) for _ in "ab")
    pairs = CandidateSimulations(theta, torch.zeros(1, 1), x, replicate=again)
    assert "smoothing misses 100%" in NestedGain().problems(pairs)[0]
    few = pairs.samples(slice(10))
    assert "fewer than 20 complete" in NestedGain().problems(few)[0]


def test_rounding_chooses_no_metric():
    """Linear outcomes leave errors of rounding alone, which vary with threads."""
    torch.manual_seed(0)
    for _ in range(4):
        theta = torch.randn(100, 2, dtype=torch.float64)
        noise = 1e-14 * torch.randn_like(theta)
        fits = [MeanEmulator.fit(theta, 3 * theta + n) for n in (0 * noise, noise)]
        assert torch.allclose(fits[0].transform, fits[1].transform)
