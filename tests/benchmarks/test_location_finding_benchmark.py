"""Location finding: bounds against closed forms, beliefs, policies and roll-outs.

Tolerances are multiples of stated standard errors; seeds are fixed.
"""

import argparse
import csv
import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from benchmarks.location_finding import run as run_module
from benchmarks.location_finding.bounds import (
    contrastive_bounds,
)
from benchmarks.location_finding.run import table


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


# ------------------------------------------------------------------ the bounds


def linear_gaussian(n: int, num_contrastive: int) -> tuple[Tensor, ...]:
    """Return log p(h|theta_0), log p(h|theta_l), log p(h) of x_t = a_t theta + noise.

    The information is .5 log(1 + sum a_t^2).
    """
    slope = torch.tensor([1.0, 2.0, -1.5], dtype=torch.float64)
    theta = normal(n, 1, seed=0)
    x = theta * slope + normal(n, 3, seed=1)
    other = normal(n, num_contrastive, 1, seed=2)
    log_p_true = Normal(theta * slope, 1).log_prob(x).sum(1)
    log_p = Normal(other * slope, 1).log_prob(x[:, None]).sum(2)
    covariance = torch.eye(3, dtype=torch.float64) + slope[:, None] * slope
    evidence = torch.distributions.MultivariateNormal(
        torch.zeros(3).double(), covariance
    )
    return theta, x, log_p_true, log_p, evidence.log_prob(x)


INFORMATION = 0.5 * math.log(1 + 1 + 4 + 2.25)


@pytest.mark.parametrize("num_contrastive", [5, 1_000])
def test_contrastive_bounds_bracket_the_linear_gaussian_information(num_contrastive):
    _, _, log_p_true, log_p, _ = linear_gaussian(4_000, num_contrastive)
    lower, upper = contrastive_bounds(log_p_true, log_p)
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


# ------------------------------------------------------------------ the beliefs


# ------------------------------------------------------------------ the policies


# ------------------------------------------------------------------ the roll-outs


def test_run_goes_on_where_it_stopped(tmp_path, capsys):
    def rows(rollouts: int) -> list[str]:
        arguments = argparse.Namespace(
            trials=1, contrastive=100, first=0, rollouts=rollouts, out=tmp_path
        )
        run_module.run("random", arguments)
        with (tmp_path / "random_1_L100.csv").open(newline="") as file:
            return [row["rollout"] for row in csv.DictReader(file)]

    assert rows(2) == ["0", "1"]
    capsys.readouterr()
    assert rows(3) == ["0", "1", "2"]
    assert capsys.readouterr().out.count("CPU s") == 1
    text = table(tmp_path, 1, 100)
    assert "random (3)" in text
    assert "Foster" not in text  # published for 30 trials
