import math

import pytest
import torch

from sbi_active import GaussianNoise, SimulatorModel

pytest.importorskip("mujoco")
from sbi_active.tasks.box_collision import BoxCollisionReference  # noqa: E402

SD = 0.02


def slide(theta, action):
    """A closed form like the scene: x grows with the speed, and ends at an edge."""
    table, cube, density = theta.double().unbind(-1)
    speed = action.double()[:, 0] / (1 + 3 * density)
    x = speed.square() / (4 + 16 * (table + 0.5 * cube))
    x = x.where(x < 1, torch.nan)
    return torch.stack([x, 0 * x, 0 * x + 0.075], -1)


MODEL = SimulatorModel(slide, noise=GaussianNoise(SD))
TRUTH = torch.tensor([[0.6, 0.5, 0.4]])


def trials(*speeds):
    action = torch.tensor(speeds)[:, None]
    seeds = torch.arange(len(speeds))
    return action, MODEL(TRUTH.expand(len(speeds), 3), action, seeds)


def log_likelihood(theta, action, x):
    """Written anew, trial by trial."""
    total = torch.zeros(len(theta), dtype=torch.float64)
    for xi, observed in zip(action, x, strict=True):
        mean = slide(theta, xi.expand(len(theta), 1))
        off = mean[:, 0].isnan()
        if observed.isnan().all():
            total = total.where(off, -torch.inf)
        else:
            z = (observed - mean) / SD
            log_density = (-0.5 * z**2 - math.log(SD * math.sqrt(2 * math.pi))).sum(-1)
            total = (total + log_density).where(~off, -torch.inf)
    return total


def grid(num):
    middle = (torch.arange(num, dtype=torch.float64) + 0.5) / num
    return torch.cartesian_prod(middle, middle, middle)


@pytest.mark.parametrize("speeds", [(3.0, 5.0), (2.0, 4.0, 12.0)])
def test_agrees_with_a_grid(speeds):
    action, x = trials(*speeds)
    assert bool(x.isnan().any()) == (12.0 in speeds)
    reference = BoxCollisionReference(MODEL, action, x, num_simulations=24_000)
    theta = grid(100)
    log_weight = log_likelihood(theta, action, x)
    log_evidence = log_weight.logsumexp(0) - math.log(len(theta))
    se = reference.log_evidence_se
    assert 0 < se < 0.05
    # The midpoint rule is off by far less than the draws.
    assert abs(reference.log_evidence - float(log_evidence)) < 4 * se
    assert float(reference.log_prob(TRUTH)) == pytest.approx(
        float(log_likelihood(TRUTH, action, x)[0]) - reference.log_evidence
    )
    weight = log_weight.softmax(0)
    mean = weight @ theta
    sd = (weight @ (theta - mean) ** 2).sqrt()
    draws = reference.sample(4000, seed=0)
    error = sd / reference.effective_sample_size**0.5 + sd / 4000**0.5
    assert bool(((draws.mean(0) - mean).abs() < 4 * error).all())
    assert reference.num_simulations <= 24_000 + 1 * len(speeds)
