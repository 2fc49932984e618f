import pytest
import torch
from scipy import stats

from sbi_active import GaussianNoise, SimulatorModel, simulate
from sbi_active.simulation.simulator import require_noise


def global_generator(theta, action):
    return theta * action + torch.randn_like(theta)


def test_the_global_generator_is_left_alone():
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    simulate(global_generator, torch.rand(5, 1), torch.rand(5, 1), seed=0)
    torch.manual_seed(3)
    assert torch.equal(torch.rand(1), expected)


def test_noise_of_a_model_has_its_sd_and_density():
    noise = GaussianNoise(torch.tensor([0.5, 2.0]))
    model = SimulatorModel(lambda t, a: torch.cat([t, a], 1), noise=noise)
    theta = torch.zeros(20_000, 1)
    x = simulate(model, theta, theta, seed=0).x.double()
    # The sd of an estimated sd is sd / sqrt(2 n).
    error = (x.std(0) / noise.sd - 1).abs()
    assert (error < 4 / (2 * 20_000) ** 0.5).all()
    expected = stats.norm(0, [0.5, 2.0]).logpdf(x[:10].numpy()).sum(1)
    assert noise.log_prob(x[:10], torch.zeros(10, 2)).numpy() == pytest.approx(expected)


def test_deterministic_simulators_are_told():
    theta = torch.rand(40, 1)
    with pytest.raises(ValueError, match="got identical x from two seeds"):
        simulate(lambda t, a: t * a, theta, theta, seed=0, check_noise=True)
    simulate(global_generator, theta, theta, seed=0, check_noise=True)


def test_counts_that_are_equal_by_chance_prove_no_missing_noise():
    counts = torch.tensor([[1.0], [0.0], *[[1.0]] * 14])
    require_noise(counts, counts)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.ones(16, 1), torch.ones(16, 1))
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.arange(16.0)[:, None], torch.arange(16.0)[:, None])
