"""Error models and NUTS over denoised outcomes."""

import pytest
import torch

from sbi_active.pyro import ChannelBias, SpikeAndSlab, StudentError, denoise
from sbi_active.seeding import forked_generators

pytest.importorskip("pyro")


@pytest.mark.slow
def test_a_gross_channel_is_told_and_goes_back_to_the_predictive():
    with forked_generators(0):
        predictive = 2.0 + 3.0 * torch.randn(1_000, 2)
    x_o = torch.tensor([3.0, 500.0])
    found = denoise(x_o, predictive, SpikeAndSlab(), seed=0)
    assert found.probability[0] < 0.05
    assert found.probability[1] > 0.99
    assert float(found.x[:, 0].median()) == pytest.approx(3.0, abs=0.1)
    assert float(found.x[:, 1].mean()) == pytest.approx(2.0, abs=0.6)
    assert float(found.x[:, 1].std()) == pytest.approx(3.0, rel=0.2)
    assert "divergences" in str(found)


@pytest.mark.parametrize("model", [SpikeAndSlab(), ChannelBias(), StudentError()])
def test_errors_count_by_their_size(model):
    x = torch.zeros(1, 2)
    probability = model.misspecified(x, torch.tensor([0.0, 50.0]))
    assert probability[0, 0] < 0.05
    assert probability[0, 1] > 0.95


def test_bad_outcomes_are_errors():
    draws = torch.randn(30, 2)
    with pytest.raises(ValueError, match="flat outcomes"):
        denoise(torch.zeros(3), draws, SpikeAndSlab(), seed=0)
    with pytest.raises(ValueError, match="finite"):
        denoise(torch.tensor([0.0, torch.nan]), draws, SpikeAndSlab(), seed=0)
