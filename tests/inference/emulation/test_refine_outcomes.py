"""Trials without a measurement, against posteriors on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.inference import RefinementOptions, refine
from sbi_active.seeding import forked_generators

PRIOR = BoxUniform(-torch.ones(2), torch.ones(2))
ACTIONS = torch.tensor([-2.0, -1.0, 1.0, 2.0])
SD = 0.2
NUM = 300  # cells an axis of the grid
AXIS = (torch.arange(NUM, dtype=torch.float64) + 0.5) * 2 / NUM - 1
GRID = torch.cartesian_prod(AXIS, AXIS)
LOG_CELL = 2 * math.log(2 / NUM)


def mean(theta: Tensor, action: Tensor) -> Tensor:
    return theta[:, :1] * action + theta[:, 1:]


@dataclass
class World:
    """x is Gaussian where it is observed, which it is with a probability."""

    probability_valid: Callable[[Tensor, Tensor], Tensor]

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        x = mean(theta, action) + SD * torch.randn(len(theta), 1)
        valid = torch.rand(len(theta), 1) < self.probability_valid(theta, action)
        return torch.where(valid, x, torch.nan)

    def log_exact(self, action: Tensor, x: Tensor, *, count_invalid: bool = True):
        """Return the exact log probability of each cell."""
        log_p = torch.zeros(len(GRID), dtype=torch.float64)
        for a, x_k in zip(action.double(), x.double(), strict=True):
            rows = a.expand(len(GRID), 1)
            valid = self.probability_valid(GRID, rows)[:, 0].double()
            if x_k.isfinite().all():
                log_p -= 0.5 * ((x_k - mean(GRID, rows)[:, 0]) / SD) ** 2
            if count_invalid:
                log_p += (valid if x_k.isfinite().all() else 1 - valid).log()
        return log_p - log_p.logsumexp(0)


WORLDS = {
    # A hard edge: an object that falls off the table beyond .3.
    "edge": World(lambda t, a: (t[:, :1] * a < 0.3).double()),
    # Chance that depends on parameter and action.
    "dropout": World(lambda t, a: torch.sigmoid(0.5 + 3 * t[:, :1] * a)),
    # Mostly without a measurement.
    "rare": World(lambda t, a: torch.sigmoid(-1.5 + 2 * t[:, 1:] * a)),
}


def trials(world: World, num: int, seed: int, *, all_invalid: bool):
    with forked_generators(seed, "trials"):
        for _ in range(10_000):
            theta = PRIOR.sample((1,)).expand(num, -1)
            action = ACTIONS[torch.randint(4, (num,))][:, None]
            x = world(theta, action)
            invalid = x.isnan().any(1)
            if invalid.all() if all_invalid else invalid.any() and not invalid.all():
                return action, x
    raise AssertionError("no such trials")


def divergence(log_p: Tensor, log_q: Tensor) -> float:
    p = log_p.exp()
    return float((p * (log_p - log_q))[p > 0].sum())


def scored(world: World, num: int, seed: int, *, all_invalid: bool = False):
    """Return KL(exact, belief), KL(exact, invalid trials ignored), and the belief."""
    action, x = trials(world, num, seed, all_invalid=all_invalid)
    belief = refine(world, PRIOR, action, x, seed=seed)
    log_b = belief.log_prob(GRID.float()).double() + LOG_CELL
    assert abs(float(log_b.logsumexp(0))) < 0.05  # normalized
    exact = world.log_exact(action, x)
    ignoring = world.log_exact(action, x, count_invalid=False)
    return divergence(exact, log_b), divergence(exact, ignoring), belief


@pytest.mark.parametrize(
    ("name", "all_invalid"), [("edge", False), ("rare", False), ("dropout", True)]
)
def test_close_to_the_exact_posterior(name: str, all_invalid: bool):
    runs = [scored(WORLDS[name], 4, seed, all_invalid=all_invalid) for seed in range(2)]
    divergences = torch.tensor([run[0] for run in runs])
    assert divergences.max() < 0.1
    assert all(run[2].diagnostics.trustworthy for run in runs)
    # Negative control: what trials without a measurement tell is missed without them.
    ignoring = torch.tensor([run[1] for run in runs])
    assert ignoring.mean() > 0.2
    if all_invalid:
        assert ignoring.min() > 0.4


def test_numbers_that_were_not_observed_are_left_out():
    """Each of two channels sees one parameter and drops out, the second by theta_2."""

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        x = action * theta + SD * torch.randn_like(theta)
        lost = torch.rand_like(theta) < torch.tensor([0.3, 0.0])
        lost[:, 1] = theta[:, 1] > 0.5
        return torch.where(lost, torch.nan, x)

    action = torch.tensor([[1.0], [2.0], [1.0]])
    x = torch.tensor([[0.3, torch.nan], [torch.nan, 0.4], [0.1, 0.1]])
    belief = refine(simulator, PRIOR, action, x, seed=0)
    # theta_1 by trials 0 and 2; theta_2 by trials 1 and 2, of precisions 4 and 1. Its
    # absence in trial 0 is not used, though it contradicts the others here.
    sd = SD / torch.tensor([2.0, 5.0]).sqrt()
    center = torch.tensor([0.2, (2 * 0.4 + 0.1) / 5])
    inside = (GRID[:, 1] < 0.5).double().log()
    z = (GRID - center) / sd
    exact = -0.5 * z.square().sum(1) + inside
    exact = exact - exact.logsumexp(0)
    log_b = belief.log_prob(GRID.float()).double() + LOG_CELL
    assert divergence(exact, log_b) < 0.1
    # negative control: with trial 2 complete in the first number only
    less = torch.where(torch.tensor([[False, True]]), torch.nan, x[2:])
    other = refine(simulator, PRIOR, action[2:], less, seed=0)
    log_b = other.log_prob(GRID.float()).double() + LOG_CELL
    assert divergence(exact, log_b) > 1


def test_an_edge_that_the_regression_cannot_follow_is_flagged():
    """Stripes of .1 on the whole prior: no cubic, and no zoom to help."""
    stripes = World(lambda t, a: ((t[:, :1] * 10).floor() % 2 == 0).double())
    action, x = torch.ones(1, 1), torch.full((1, 1), torch.nan)
    diagnostics = refine(stripes, PRIOR, action, x, seed=0).diagnostics
    assert not diagnostics.assumptions["outcomes_followed"].holds
    assert "followed coarsely" in " ".join(diagnostics.warnings)


def test_lost_rows_cost_nothing_else():
    world = WORLDS["edge"]

    def faulty(theta: Tensor, action: Tensor) -> Tensor:
        if bool((theta[:, 0] * 1e4 % 20 < 1).any()):
            raise RuntimeError("licence server")
        return world(theta, action)

    action, x = trials(world, 2, 0, all_invalid=False)
    settings = RefinementOptions(num_histories=500)
    with pytest.warns(UserWarning, match="simulations of the refinement are missing"):
        belief = refine(faulty, PRIOR, action, x, settings=settings, seed=0)
    diagnostics = belief.diagnostics
    assert 0 < diagnostics.num_missing < 0.3 * diagnostics.num_simulations
    log_b = belief.log_prob(GRID.float()).double() + LOG_CELL
    assert divergence(world.log_exact(action, x), log_b) < 0.1
