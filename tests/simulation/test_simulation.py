import pytest
import torch

from sbi_active.simulation.simulator import require_noise


def test_counts_that_are_equal_by_chance_prove_no_missing_noise():
    counts = torch.tensor([[1.0], [0.0], *[[1.0]] * 14])
    require_noise(counts, counts)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.ones(16, 1), torch.ones(16, 1))
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.arange(16.0)[:, None], torch.arange(16.0)[:, None])
