"""Nested Monte Carlo against closed forms and the oscillator's reference.

Tolerances are four standard errors and a stated bound of the bias.
"""

import math

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
from tests.design.estimators.test_entropy import ACTIONS, declared
from tests.linear_gaussian import PRIOR, information

BIAS = 0.05  # of 16 local draws, l


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


def test_the_closed_form():
    actions = torch.tensor([[0.0], [0.5], [2.0], [20.0], [500.0]])
    gain, error = estimate(declared(n=400, actions=actions))
    assert ((gain - information(actions)).abs() < 4 * error + BIAS).all()
    assert float(gain[0].abs()) < 4 * float(error[0]) + 0.01


def test_a_wrong_declaration_is_wrong():
    gain, error = estimate(declared(n=400, declared_sd=0.5))
    wrong = (gain - information(ACTIONS)).abs() > 4 * error + BIAS
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


SHEAR = SimulatorModel(shear, noise=GaussianNoise(SD))


def test_where_the_emulator_misses_slopes_of_the_simulator_count():
    """A rough shear keeps volumes: 11.6 nats; without slopes they were thousands."""
    action = torch.zeros(1, 1)
    sampler = CandidateSampler(
        *(SHEAR, PRIOR, action, 0, IN_PROCESS, torch.empty(0, 1), 200, True)
    )
    rows = sampler.draw(300, action)
    assert NestedGain().needs_slopes(rows)
    sloped = sampler.add_slopes(rows)
    assert sampler.num_drawn == 300 + 2 * 64
    gain, error = estimate(sloped)
    exact = -2 * math.log(SD)
    assert abs(float(gain) - exact) < 3 * float(error) + BIAS
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
    assert abs(float(gain) - math.log(2)) < 3 * float(error) + BIAS
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
