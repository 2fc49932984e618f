"""Interpolated noise-free outcomes."""

import torch

from sbi_active.design.estimators.emulator import MeanEmulator


def test_draws_that_are_all_alike_have_their_outcome():
    # As those of a belief that has collapsed to a draw.
    theta = torch.full((60, 3), 0.37).double()
    emulator = MeanEmulator.fit(theta, torch.full((60, 4), 2.0).double())
    torch.testing.assert_close(
        emulator(emulator.knots), torch.full((60, 4), 2.0).double()
    )


def test_a_smooth_outcome_is_followed():
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(200, 2, generator=generator).double()
    f = torch.stack([theta[:, 0] ** 2, torch.sin(3 * theta[:, 1])], 1)
    emulator = MeanEmulator.fit(theta[:150], f[:150])
    found = emulator(emulator.coordinates(theta[150:]))
    assert float((found - f[150:]).abs().max()) < 0.02
