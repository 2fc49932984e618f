"""Outcomes with many numbers, of which a network sees a few directions."""

import torch
from torch.distributions import MultivariateNormal

from sbi_active.inference.networks.conditioning import Conditioning
from sbi_active.inference.networks.mixture_density import (
    MixtureDensity,
    train_mixture_density,
)
from sbi_active.inference.sampling.adam import Adam
from sbi_active.seeding import forked_generators

NUM, SD = 300, 2.0
ALL_ROWS = {"scaling": "action", "whiten": True, "baseline": "best"}
TIMES = torch.linspace(0.1, 1.0, NUM)
BASIS = torch.stack([TIMES, torch.sin(8 * TIMES)])


ALL_ROWS = {"scaling": "action", "whiten": True, "baseline": "best"}


def rows(num: int, seed: int):
    with forked_generators(seed):
        theta, action = torch.randn(num, 2), 0.5 + torch.rand(num, 1)
        x = action * (theta @ BASIS) + SD * torch.randn(num, NUM)
    return theta, torch.cat([x, action], 1)


def exact(theta, condition):
    x, action = condition.double().split([NUM, 1], 1)
    slope = action[:, :, None] * BASIS.double().T / SD
    precision = torch.eye(2).double() + slope.mT @ slope
    pull = slope.mT @ (x / SD)[..., None]
    mean = torch.linalg.solve(precision, pull)[..., 0]
    own = MultivariateNormal(mean, precision_matrix=precision)
    return own.log_prob(theta.double()).mean()


def test_a_network_of_many_numbers_comes_near_the_exact_posterior():
    theta, condition = rows(4_000, 0)
    with forked_generators(1):
        network = MixtureDensity().build(theta, condition, 1)
        train_mixture_density(
            network,
            Adam(network.parameters(), rate=1.5e-2),
            theta,
            condition,
            train_rows=torch.arange(3_600),
            held_out_rows=torch.arange(3_600, 4_000),
            num_iterations=160,
            batch_size=200,
            anneal=True,
        )
    assert network.baseline_kind == "linear"
    theta, condition = rows(2_000, 2)
    with torch.no_grad():
        score = network.log_prob(theta[None], condition).mean()
    assert exact(theta, condition) - score < 0.15


def test_an_outcome_that_lacks_a_number_is_seen_by_the_others():
    theta, condition = rows(300, 0)
    whole = condition.clone()
    condition[5, :NUM], condition[9, 4] = torch.nan, torch.nan
    own = Conditioning(theta, condition, 1, **ALL_ROWS)
    assert own.num_frames == 2
    seen, frames = own(condition)
    before, _ = own(whole)
    assert bool(seen.isfinite().all())
    directions = slice(0, 32)
    assert bool((seen[5, directions] == 0).all())  # nothing was measured
    apart = (seen[9] - before[9])[directions].norm()
    assert float(apart) < 0.2 * float(before[9, directions].norm())
    # No frame is trusted where a number lacks.
    for row in (5, 9):
        assert bool((frames.mean[row] == 0).all())
