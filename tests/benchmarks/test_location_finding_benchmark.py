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
    history_log_likelihood,
    posterior_bounds,
)
from benchmarks.location_finding.particles import ParticleBelief
from benchmarks.location_finding.summary import table
from sbi_active.tasks import get_task
from sbi_active.tasks.location_finding.model import (
    NOISE_SD,
    mean,
)


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def history(num_sources: int, num_trials: int, seed: int) -> tuple[Tensor, ...]:
    """Return a truth of the prior, random places and outcomes."""
    theta = normal(2 * num_sources, seed=seed)
    action = normal(num_trials, 2, seed=seed + 1)
    x = mean(theta[None, None], action)[0]
    return theta, action, x + NOISE_SD * normal(num_trials, 1, seed=seed + 2)


def grid_posterior(action: Tensor, x: Tensor) -> tuple[float, Tensor]:
    """Return log evidence and mean of one source by quadrature on a fine grid."""
    line = torch.linspace(-5, 5, 801, dtype=torch.float64)
    place = torch.cartesian_prod(line, line)
    log_joint = history_log_likelihood(place, action, x)
    log_joint += Normal(0, 1).log_prob(place).sum(1)
    log_evidence = log_joint.logsumexp(0) + 2 * (line[1] - line[0]).log()
    return float(log_evidence), log_joint.softmax(0) @ place


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


def test_posterior_bounds_of_one_source_are_the_quadrature_s():
    theta, action, x = history(1, 6, seed=10)
    log_evidence, _ = grid_posterior(action, x)
    exact = float(history_log_likelihood(theta[None], action, x)) - log_evidence
    belief = ParticleBelief(get_task("location_finding", num_sources=1), seed=0)
    for place, value in zip(action, x, strict=True):
        belief.update(place, value)
    lower, upper, effective = posterior_bounds(belief.theta, action, x, theta, seed=0)
    assert effective > 1_000
    assert lower == pytest.approx(exact, abs=4 / effective**0.5)
    assert upper == pytest.approx(exact, abs=4 / effective**0.5)


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
    assert capsys.readouterr().out.count("information in") == 1
    text = table(tmp_path, 1, 100)
    assert "random (3)" in text
    assert "Foster" not in text  # published for 30 trials
