"""Location and scale of outcomes given the action."""

import math

import pytest
import torch

from sbi_active.inference.networks.action_scaling import ActionScaling
from sbi_active.inference.networks.baseline import Baseline, precision_factor
from sbi_active.inference.networks.response import Response


@pytest.mark.parametrize("shift", [0.0, -3.0], ids=["round 1", "sharp belief"])
def test_location_and_scale_over_four_decades(shift):
    """The true ones within five standard errors, at -9000 with spread 15 as well."""
    torch.manual_seed(0)
    n = 5_000
    action = torch.randint(21, (n, 1)).double() * 0.5 - 5
    spread = 0.005 if shift else 3.0
    rate = torch.exp(3 - action)
    x = (shift + spread * torch.randn(n, 1).double()) * rate + torch.randn(n, 1)
    scaling = ActionScaling(x, action)
    grid = torch.linspace(-5, 5, 41, dtype=torch.float64)[:, None]  # half of it unseen
    location, scale = scaling.location_and_scale(grid)
    rate = torch.exp(3 - grid)
    truth = (1 + (spread * rate) ** 2).sqrt()
    error = truth / math.sqrt(n / 41)  # each degree of freedom sees that many rows
    assert ((location - shift * rate).abs() < 5 * error).all()
    assert (scale / truth).log().abs().max() < 0.35
    z = scaling(x, action)
    assert abs(float(z.mean())) < 5 / math.sqrt(n)
    assert float(z.std()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("seed", [1])
def test_isolated_actions_leave_a_finite_noise(seed):
    g = torch.Generator().manual_seed(seed)
    action = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]).repeat(100)
    # A few rows far from the others: between, the noise's polynomial is free to dive.
    far = torch.tensor([3.5, 3.5, 3.5, 5.5, 10.0])
    action = torch.cat([action, far])[:, None].double()
    u = torch.randn(len(action), 3, generator=g, dtype=torch.float64)
    e = torch.randn(len(action), 3, generator=g, dtype=torch.float64)
    moved = (action - 1.5).clamp_min(0.0)  # slow ones move nothing
    x = moved * (1 + 0.3 * u[:, :1] + 0.1 * u[:, 1:2] ** 2) + 0.005 * e[:, :1]
    y = torch.cat([x, e[:, 1:]], 1)
    y = (y - y.mean(0)) / y.std(0)
    response = Response(u, y, action, kind="linear")
    assert float(response.log_low.min()) > -20
    everywhere = torch.linspace(0.0, 10.0, 101, dtype=torch.float64)[:, None]
    assert all(part.isfinite().all() for part in response.weights(everywhere))
    frames = Baseline(u, y, action, kind="linear")(y, action)
    assert all(part.isfinite().all() for part in frames)


def test_a_precision_that_is_not_finite_is_an_error():
    precision = torch.tensor([[[[1.0, 0.0], [0.0, torch.nan]]]], dtype=torch.float64)
    with pytest.raises(ValueError, match="expected a regression of the outcomes"):
        precision_factor(precision)
