"""Error models and NUTS over denoised outcomes."""

import pytest
import torch
from torch.distributions import Normal, StudentT

from sbi_active.pyro import ChannelBias, SpikeAndSlab, StudentError
from sbi_active.pyro.denoising import denoise
from sbi_active.seeding import forked_generators

pytest.importorskip("pyro")

MODELS = [SpikeAndSlab(), ChannelBias(), StudentError()]


def predictive(*shape, correlation=0.0):
    with forked_generators(0):
        draws = torch.randn(*shape)
    cov = torch.full((shape[1], shape[1]), correlation).fill_diagonal_(1.0)
    return draws @ torch.linalg.cholesky(cov).T


@pytest.mark.slow
def test_a_gross_channel_is_told_and_goes_back_to_the_predictive():
    x_o = torch.tensor([3.0, 500.0])
    found = denoise(x_o, 2.0 + 3.0 * predictive(1_000, 2), SpikeAndSlab(), seed=0)
    assert found.probability[0] < 0.1
    assert found.probability[1] > 0.99
    assert float(found.x[:, 0].median()) == pytest.approx(3.0, abs=0.1)
    assert float(found.x[:, 1].mean()) == pytest.approx(2.0, abs=0.8)
    assert float(found.x[:, 1].std()) == pytest.approx(3.0, rel=0.25)
    assert found.r_hat < 1.1
    assert "divergences" in str(found)


@pytest.mark.slow
def test_a_channel_that_was_not_observed_follows_the_others():
    draws = predictive(1_000, 2, correlation=0.99)
    found = denoise(torch.tensor([1.5, torch.nan]), draws, SpikeAndSlab(), seed=0)
    kept = found.x[(found.x[:, 0] - 1.5).abs() < 0.1]
    assert len(kept) > 200
    assert float(kept[:, 1].mean()) == pytest.approx(1.5, abs=0.1)
    assert float(kept[:, 1].std()) == pytest.approx((1 - 0.99**2) ** 0.5, rel=0.3)
    assert found.probability.isnan().tolist() == [False, True]


def test_nothing_observed_leaves_the_predictive():
    draws = 5.0 + predictive(1_000, 2)
    found = denoise(torch.full((2,), torch.nan), draws, SpikeAndSlab(), seed=0)
    assert float(found.x.mean()) == pytest.approx(5.0, abs=0.2)
    assert found.num_divergences == 0


@pytest.mark.parametrize("model", MODELS)
def test_errors_count_by_their_size(model):
    x = torch.zeros(1, 2)
    probability = model.misspecified(x, torch.tensor([0.0, 50.0]))
    assert probability[0, 0] < 0.05
    assert probability[0, 1] > 0.95


@pytest.mark.parametrize("model", MODELS)
def test_deviations_give_the_errors_of_the_program(model):
    """The normal errors of all deviations, summed, are the density of an outcome."""
    log_sd = torch.linspace(-12.0, 12.0, 20_001).double()
    step = log_sd[1] - log_sd[0]
    weight = model.log_deviation(log_sd).exp() * step
    assert float(weight.sum()) == pytest.approx(1.0, abs=1e-3)
    errors = torch.tensor([0.0, 0.004, 1.0, 30.0]).double()
    summed = (Normal(0.0, log_sd.exp()).log_prob(errors[:, None]).exp() * weight).sum(1)
    if isinstance(model, StudentError):
        exact = StudentT(model.df, 0.0, model.scale).log_prob(errors).exp()
    else:
        parts = model._parts(torch.zeros(4, 1), errors[:, None])
        exact = parts.logsumexp(0)[:, 0].exp()
    # A known deviation is rounded by a tenth, which tells in the tails of a normal.
    assert summed[:3].tolist() == pytest.approx(exact[:3].tolist(), rel=0.03)
    assert summed[3] >= 0.97 * exact[3]
