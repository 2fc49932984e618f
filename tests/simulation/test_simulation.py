import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active import GaussianNoise, SimulatorModel, simulate
from sbi_active.seeding import row_normals
from sbi_active.simulation.simulator import require_noise


def global_generator(theta, action):
    return theta * action + torch.randn_like(theta)


def numpy_generator(theta, action):
    return theta.numpy() * action.numpy() + np.random.randn(*theta.shape)


def seeded(theta, action, seeds):
    return theta * action + row_normals(seeds, 1).float()


SIMULATORS = [
    global_generator,
    numpy_generator,
    seeded,
    SimulatorModel(lambda t, a: t * a, noise=GaussianNoise(1.0)),
]


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_x_is_a_function_of_the_seed(simulator):
    theta, action = torch.rand(600, 1), torch.rand(600, 1)
    first = simulate(simulator, theta, action, seed=1)
    torch.manual_seed(99)
    assert torch.equal(first.x, simulate(simulator, theta, action, seed=1).x)
    assert not torch.equal(first.x, simulate(simulator, theta, action, seed=2).x)
    fewer = simulate(simulator, theta[:256], action[:256], seed=1)
    assert torch.equal(first.x[:256], fewer.x)
    assert first.x.dtype == torch.float32


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


def test_mean_is_noise_free_and_refused_without_noise():
    theta = torch.ones(2, 1)
    assert torch.equal(SIMULATORS[3].mean(theta, theta), theta)
    with pytest.raises(ValueError, match="expected a simulator with a noise model"):
        SimulatorModel(global_generator).mean(theta, theta)


def test_deterministic_simulators_are_told():
    theta = torch.rand(40, 1)
    with pytest.raises(ValueError, match="got identical x from two seeds"):
        simulate(lambda t, a: t * a, theta, theta, seed=0, check_noise=True)
    simulate(global_generator, theta, theta, seed=0, check_noise=True)


def test_invalid_rows_are_known():
    rows = simulate(
        lambda t, a: torch.where(t > 0, t, torch.nan),
        torch.tensor([[1.0], [-1.0]]),
        torch.zeros(2, 1),
        seed=0,
    )
    assert rows.valid.tolist() == [True, False]


def test_one_number_a_row_becomes_a_column():
    rows = simulate(lambda t, a: t[:, 0], torch.rand(3, 2), torch.rand(3, 1), seed=0)
    assert rows.x.shape == (3, 1)


@pytest.mark.parametrize(
    ("simulator", "theta", "text"),
    [
        (lambda t, a: t[:1], torch.rand(3, 1), "one row a parameter set"),
        (lambda t, a: t, torch.rand(2, 1), "with as many rows"),
        (lambda t, a: t, torch.rand(3), "with as many rows"),
    ],
)
def test_wrong_shapes(simulator, theta, text):
    with pytest.raises(ValueError, match=text):
        simulate(simulator, theta, torch.rand(3, 1), seed=0)


def test_negative_sd():
    with pytest.raises(ValueError, match="expected a standard deviation >= 0"):
        GaussianNoise(-1.0)


def test_counts_that_are_equal_by_chance_prove_no_missing_noise():
    counts = torch.tensor([[1.0], [0.0], *[[1.0]] * 14])
    require_noise(counts, counts)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.ones(16, 1), torch.ones(16, 1))
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.arange(16.0)[:, None], torch.arange(16.0)[:, None])
