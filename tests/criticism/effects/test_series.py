"""Delays, lags, backlash and quanta against slow, plain versions of them."""

import numpy as np
import pytest
import torch

from sbi_active.criticism.effects.changes import (
    delayed_input,
    delayed_samples,
    lagged_input,
    lagged_samples,
    played,
    rounded,
)

STEP = torch.tensor(0.1).double()


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def column(*values):
    return torch.tensor(values).double()[:, None]


def test_a_lag_is_that_of_fine_integration():
    u, tau = random(3, 40), column(0.03, 0.1, 0.5)
    fine = 2000
    for row in range(3):
        y, means = float(u[row, 0]), []
        for value in u[row].tolist():
            path = []
            for _ in range(fine):
                path.append(y)
                y += float(STEP) / fine * (value - y) / float(tau[row])
            means.append(np.mean([*path[1:], y]) / 2 + np.mean(path) / 2)
        found = lagged_input(u[row : row + 1], tau[row : row + 1], STEP)
        assert found[0].numpy() == pytest.approx(np.array(means), abs=2e-3)


def test_a_delay_by_steps_shifts():
    u = random(2, 30)
    found = delayed_input(u, column(0.2, 0.0), STEP)
    assert torch.allclose(found[0, 2:], u[0, :-2])
    assert torch.equal(found[0, :2], u[0, :1].expand(2))
    assert torch.equal(found[1], u[1])
    half = delayed_input(u, column(0.05, 0.05), STEP)
    assert torch.allclose(half[:, 1:], (u[:, 1:] + u[:, :-1]) / 2)


def test_a_backlash_is_that_of_its_definition():
    u, width = random(3, 57).cumsum(1), column(0.0, 1.0, 4.0)
    expected = torch.empty_like(u)
    y = u[:, 0]
    for k in range(57):
        y = torch.minimum(
            torch.maximum(y, u[:, k] - width[:, 0] / 2), u[:, k] + width[:, 0] / 2
        )
        expected[:, k] = y
    assert torch.equal(played(u, width), expected)
    assert torch.equal(expected[0], u[0])


@pytest.mark.parametrize("channels", [(), (2,)])
def test_a_sensor_s_lag_is_that_of_fine_integration(channels):
    times = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.7, 1.0]).double()
    x, tau = random(2, 6, *channels), column(0.05, 0.4)
    found = lagged_samples(x, tau, times.expand(2, -1))
    fine = np.linspace(0, 1, 100_001)
    for row in range(2):
        for c in np.ndindex(*channels):
            truth = np.interp(fine, times.numpy(), x[row][(slice(None), *c)].numpy())
            y, path = truth[0], []
            keep = np.exp(-1e-5 / float(tau[row]))
            for value in truth:
                y = keep * y + (1 - keep) * value
                path.append(y)
            expected = np.interp(times.numpy(), fine, path)
            own = found[row][(slice(None), *c)].numpy()
            assert own == pytest.approx(expected, abs=1e-3)


def test_a_sensor_s_delay_reads_between_its_samples():
    times = torch.tensor([[0.0, 0.1, 0.3, 0.3, 0.3]]).double()  # padded
    x = torch.tensor([[1.0, 2.0, 4.0, 4.0, 4.0]]).double()
    found = delayed_samples(x, column(0.05), times)
    assert found[0, :3].tolist() == pytest.approx([1.0, 1.5, 3.5])
    assert torch.equal(delayed_samples(x, column(0.0), times), x)
    two = delayed_samples(torch.stack([x, -x], -1), column(0.05), times)
    assert two[0, :3, 1].tolist() == pytest.approx([-1.0, -1.5, -3.5])


def test_padding_of_a_lagged_trial_is_no_number_lost():
    times = torch.tensor([[0.0, 0.1, 0.3, 0.3, 0.3]]).double()
    x = torch.tensor([[1.0, 2.0, 4.0, 4.0, 4.0]]).double()
    whole = lagged_samples(x, column(0.2), times)
    part = lagged_samples(x[:, :3], column(0.2), times[:, :3])
    assert torch.allclose(whole[:, :3], part)
    assert bool(whole.isfinite().all())


def test_a_quantum_rounds():
    x = torch.tensor([[0.12, -0.37]]).double()
    assert rounded(x, column(0.1))[0].tolist() == pytest.approx([0.1, -0.4])
    assert torch.equal(rounded(x, column(0.0)), x)


@pytest.mark.parametrize(
    "change",
    [
        lambda u, phi: lagged_input(u, phi, STEP),
        lambda u, phi: delayed_input(u, phi, STEP),
        played,
        lambda x, phi: lagged_samples(
            x, phi, 0.1 * torch.arange(x.shape[1])[None].double()
        ),
        lambda x, phi: delayed_samples(
            x, phi, 0.1 * torch.arange(x.shape[1])[None].double()
        ),
    ],
    ids=["input lag", "input delay", "backlash", "sensor lag", "sensor delay"],
)
def test_none_is_flat_at_its_null(change):
    """A tiny phi changes the series in proportion: the derivative at 0 exists."""
    u = random(1, 50)
    assert torch.equal(change(u, column(0.0)), u)
    small, smaller = (change(u, column(p)) - u for p in (1e-5, 1e-7))
    assert float(smaller.norm()) > 1e-8
    assert torch.allclose(small / 1e-5, smaller / 1e-7, rtol=1e-2, atol=1e-2)
