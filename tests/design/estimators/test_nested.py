"""Nested Monte Carlo against closed forms and the oscillator's reference.

Tolerances are four standard errors and a stated bound of the bias.
"""

import math

import torch
from sbi.utils import BoxUniform

from sbi_active.design import EntropyGain, NestedGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.emulator import MeanEmulator, declare
from sbi_active.simulation import GaussianNoise, NoiseModel
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


def test_any_noise_model_will_do():
    class Plain(NoiseModel):  # no product of matrices for its pairwise densities
        inner = GaussianNoise(1.0)

        def sample(self, mean, seeds=None, **options):
            return self.inner.sample(mean, seeds, **options)

        def log_prob(self, x, mean, **options):
            return self.inner.log_prob(x, mean, **options)

    rows = declared(n=100)
    other = CandidateSimulations(rows.theta, ACTIONS, rows.x, rows.mean, Plain())
    gain = NestedGain()(None, rows, PRIOR)
    assert torch.allclose(NestedGain()(None, other, PRIOR), gain, atol=1e-4)


def test_six_numbers_that_four_parameters_make():
    """Gains of .3 to 7.6 nats; the emulator bends where the sensor saturates."""
    index = torch.tensor([6, 16, 23, 33])
    rows, prior = oscillator(400, index)
    assert NestedGain().problems(rows) == []
    gain, error = estimate(rows, prior)
    exact, exact_error = OscillatorReference([], []).expected_information_gain(
        model.ACTIONS[index], num_outer=400, num_inner=2_000
    )
    error = (error**2 + exact_error**2).sqrt()
    assert ((gain - exact).abs() < 3 * error + 0.1).all()
    assert ((gain - exact).abs() < 0.5).all()
    # nearest neighbors in six dimensions do not do it
    coarse = EntropyGain()(None, rows, prior).mean(1)
    assert (coarse - exact).abs().max() > 1.0


def test_noise_that_is_not_declared_is_learned():
    rows, prior = oscillator(300, torch.tensor([6, 23]))
    assert rows.mean is not None
    assert rows.noise is not None
    again = rows.noise.sample(rows.mean)
    pairs = CandidateSimulations(rows.theta, rows.action, rows.x, replicate=again)
    assert NestedGain().problems(pairs) == []
    declared_gain, error = estimate(rows, prior)
    learned, _ = estimate(pairs, prior)
    assert ((learned - declared_gain).abs() < 3 * error + 0.2).all()
    square = declare(pairs).score
    assert square.shape == (2, 6)
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


def test_missing_outcomes_count():
    """Linear in one parameter, none where theta > 0: log 2 and half of the rest."""
    torch.manual_seed(0)
    belief = BoxUniform(-torch.ones(1), torch.ones(1))
    theta = belief.sample((500,))
    mean = 100 * theta[None].expand(1, 500, 1).clone()
    x = mean + torch.randn_like(mean)
    mean[:, theta[:, 0] > 0] = torch.nan
    x[mean.isnan()] = torch.nan
    rows = CandidateSimulations(theta, torch.zeros(1, 1), x, mean, GaussianNoise(1.0))
    gain, error = estimate(rows, belief)
    # x is uniform on [-100, 0] but for edges of the width of the noise
    uniform = math.log(100) - 0.5 * (math.log(2 * math.pi) + 1)
    exact = math.log(2) + 0.5 * uniform
    assert abs(float(gain) - exact) < 4 * float(error) + BIAS


def test_the_emulator_interpolates_and_knows_its_error():
    torch.manual_seed(0)
    theta = torch.rand(400, 2, dtype=torch.float64) * torch.tensor([10.0, 1e3])

    def f(theta):
        return torch.stack([torch.sin(theta[:, 0]), theta[:, 1] / 1e2], 1)

    emulator = MeanEmulator.fit(theta, f(theta))
    at_knots = emulator(emulator.knots)
    assert torch.allclose(at_knots, f(theta), atol=1e-3)
    new = torch.rand(200, 2, dtype=torch.float64) * torch.tensor([10.0, 1e3])
    error = (emulator(emulator.coordinates(new)) - f(new)).square().mean().sqrt()
    assert float(error) < 0.02
    assert 0.3 < float(error / emulator.error.square().mean().sqrt()) < 3
    step = 1e-5 * torch.eye(2, dtype=torch.float64)
    z = emulator.knots[:5] + 0.01
    finite = [(emulator(z + h) - emulator(z - h)) / 2e-5 for h in step]
    assert torch.allclose(emulator.slope(z), torch.stack(finite, -1), atol=1e-5)
    assert torch.allclose(emulator.parameters(emulator.coordinates(new)), new)


def test_rounding_chooses_no_metric():
    """Linear outcomes leave errors of rounding alone, which vary with threads."""
    torch.manual_seed(0)
    for _ in range(4):
        theta = torch.randn(100, 2, dtype=torch.float64)
        noise = 1e-14 * torch.randn_like(theta)
        fits = [MeanEmulator.fit(theta, 3 * theta + n) for n in (0 * noise, noise)]
        assert torch.allclose(fits[0].transform, fits[1].transform)


def test_a_mean_too_rough_to_emulate_is_noticed():
    rows = declared(n=200)
    rough = 1e3 * torch.sin(1e3 * rows.theta).expand(4, 200, 2)
    rows = CandidateSimulations(rows.theta, ACTIONS, rough, rough, rows.noise)
    (problem,) = NestedGain().problems(rows)
    assert problem.startswith("the emulator misses")
