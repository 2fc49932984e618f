"""Location finding: bounds of the information against a closed form, and a roll-out.

Tolerances are multiples of stated standard errors; seeds are fixed.
"""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from benchmarks.location_finding import run
from benchmarks.location_finding.bounds import contrastive_bounds


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def linear_gaussian(n: int, num_contrastive: int) -> tuple[Tensor, Tensor]:
    """Return log p(h|theta_0) and log p(h|theta_l) of x_t = a_t theta + noise.

    The information is .5 log(1 + sum a_t^2).
    """
    slope = torch.tensor([1.0, 2.0, -1.5], dtype=torch.float64)
    theta = normal(n, 1, seed=0)
    x = theta * slope + normal(n, 3, seed=1)
    other = normal(n, num_contrastive, 1, seed=2)
    log_p_true = Normal(theta * slope, 1).log_prob(x).sum(1)
    return log_p_true, Normal(other * slope, 1).log_prob(x[:, None]).sum(2)


INFORMATION = 0.5 * math.log(1 + 1 + 4 + 2.25)


@pytest.mark.parametrize("num_contrastive", [5, 1_000])
def test_contrastive_bounds_bracket_the_linear_gaussian_information(num_contrastive):
    lower, upper = contrastive_bounds(*linear_gaussian(4_000, num_contrastive))
    error_lower, error_upper = (float(b.std()) / 4_000**0.5 for b in (lower, upper))
    assert float(lower.mean()) < INFORMATION + 3 * error_lower
    assert float(upper.mean()) > INFORMATION - 3 * error_upper
    assert bool((lower <= math.log(num_contrastive + 1)).all())
    if num_contrastive == 5:  # few draws: neither is the information
        assert float(lower.mean()) < INFORMATION - 5 * error_lower
        assert float(upper.mean()) > INFORMATION + 5 * error_upper
    else:
        assert float(lower.mean()) > INFORMATION - 4 * error_lower
        assert float(upper.mean()) < INFORMATION + 4 * error_upper


def test_a_roll_out_has_its_row_and_the_table_its_line(monkeypatch):
    monkeypatch.setattr(run, "NUM_CONTRASTIVE", 100)
    row = run.roll_out("fixed", 0, 1)
    assert row["places"] == "-1.10618 0.1085"
    assert row["spce"] <= math.log(101)
    text = run.table([{"policy": "fixed", "rollout": 0, "trials": 1, **row}])
    assert "fixed, optimized (1)" in text
    assert "Foster" not in text  # published for 30 trials
