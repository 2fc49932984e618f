"""Location and scale of outcomes given the action."""

import pytest
import torch

from sbi_active.inference.networks.baseline import Baseline
from sbi_active.inference.networks.response import Response


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
