"""Conditional densities that are fitted fast, against those of known worlds."""

import math

import pytest
import torch

from sbi_active.design.estimators.posterior import (
    conditional_members,
    log_normal,
)

CONSTANT, LINEAR, LINEAR_SCALED, QUADRATIC, KERNEL, MIXTURE = 0, 1, 2, 3, 5, 7


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def world(kind, num=600, seed=0):
    """Return u, x and the exact log p(u | x) of draws."""
    x, e = normal(num, 1, seed=seed), normal(num, 1, seed=seed + 100)
    if kind == "linear":
        mean, sd = 0.9 * x, torch.full_like(x, 0.3)
    elif kind == "scaled":
        mean, sd = 0.5 * x, (0.7 * x - 1).exp()
    elif kind == "quadratic":
        mean, sd = 0.6 * (x.square() - 1), torch.full_like(x, 0.2)
    elif kind == "wave":
        mean, sd = torch.sin(3 * x), torch.full_like(x, 0.2)
    else:  # two modes
        sign = (torch.arange(num) % 2 * 2 - 1).double()[:, None]
        mean, sd = 0.9 * sign, torch.full_like(x, 0.2)
        u = mean + sd * e
        each = [log_normal((u - m) / sd) - sd[:, 0].log() for m in (0.9, -0.9)]
        return u, x, torch.logaddexp(*each) - math.log(2)
    return mean + sd * e, x, log_normal(e) - sd[:, 0].log()


@pytest.mark.parametrize(
    ("kind", "member", "worse"),
    [
        ("linear", LINEAR, CONSTANT),
        ("scaled", LINEAR_SCALED, LINEAR),
        ("quadratic", QUADRATIC, LINEAR),
        ("wave", KERNEL, QUADRATIC),
        ("modes", MIXTURE, KERNEL),
    ],
)
def test_the_member_of_a_world_s_kind_comes_close_to_its_density(kind, member, worse):
    u, x, _ = world(kind)
    members = conditional_members(u, x)
    u, x, exact = world(kind, seed=1)
    loss = [float((exact - density(u, x)).mean()) for density in members]
    assert 0 <= loss[member] < 0.12
    assert loss[worse] > loss[member] + 0.1


@pytest.mark.parametrize("q", [0, 8])
def test_every_member_is_normalized_and_bounded_below(q):
    u, _, _ = world("scaled", 400)
    x = normal(400, q, seed=2)
    grid = torch.linspace(-30, 30, 20_001).double()[:, None]
    for density in conditional_members(u, x):
        log_p = density(grid, x[:1].expand(len(grid), q))
        total = float(torch.trapezoid(log_p.exp(), grid[:, 0]))
        assert total == pytest.approx(1, abs=1e-3)
        assert (log_p >= log_normal(grid) + math.log(0.02) - 1e-9).all()
