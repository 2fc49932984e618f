"""Location finding: the model and the task."""

import torch
from torch import Tensor
from torch.distributions import Normal

from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.location_finding.model import NOISE_SD, mean  # pyright: ignore


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def test_log_likelihood_is_a_normal_s():
    task = get_task("location_finding")
    theta, action, x = (
        normal(30, 4, seed=0),
        normal(30, 2, seed=1),
        normal(30, 1, seed=2),
    )
    expected = Normal(mean(theta, action), NOISE_SD).log_prob(x)[:, 0]
    torch.testing.assert_close(task.log_likelihood(x, theta, action), expected)
    torch.testing.assert_close(task.simulator.log_prob(x, theta, action), expected)
    assert task.exact_likelihood
