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
