"""What every estimator has in common, from one registry."""

import math
from dataclasses import replace

import pytest
import torch

from sbi_active import design
from sbi_active.design.estimators.contrast import InfoNCEGain
from sbi_active.design.estimators.emulator import MeanEmulator
from tests.linear_gaussian import (
    PRIOR,
    ExactLikelihoodAndPosterior,
    ExactModel,
    ExactRatio,
    candidates,
    information,
)

ACTIONS = torch.tensor([[0.0], [0.5], [2.0]])


class Everything(ExactLikelihoodAndPosterior, ExactRatio):
    """A model that has all methods."""

    def __init__(self):
        super().__init__()
        self.offset, self.power = 0.0, 1.0


ESTIMATORS = {
    "entropy": design.EntropyGain(),
    "info_nce": InfoNCEGain(num_contrastive=31),
    "likelihood": design.LikelihoodGain(num_contrastive=50),
    "linear": design.LinearGain(),
    "nested": design.NestedGain(),
    "posterior": design.PosteriorGain(),
    "ratio": design.RatioGain(),
}
DRAWING = {"entropy", "nested"}  # other numbers in turn
FROM_MODELS = sorted(set(ESTIMATORS) - {"entropy", "linear", "nested"})


@pytest.fixture
def rows():
    return candidates(ACTIONS, 128, declared=1.0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_shape_and_repetition(name, rows):
    estimator = ESTIMATORS[name]
    gain = estimator(Everything(), rows, PRIOR)
    assert gain.shape == (3, 128)
    assert gain.dtype == torch.float64
    assert gain.isfinite().all()
    state = torch.get_rng_state()
    again = estimator(Everything(), rows, PRIOR)
    assert torch.allclose(again, gain, rtol=0, atol=1e-6)  # the last bits may differ
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_permuting_candidates_permutes_the_gain(name, rows):
    order = torch.tensor([2, 0, 1])
    gain = ESTIMATORS[name](Everything(), rows, PRIOR)
    permuted = ESTIMATORS[name](Everything(), rows.candidates(order), PRIOR)
    tolerance = 0.1 if name in DRAWING else 1e-6
    assert torch.allclose(permuted.mean(1), gain[order].mean(1), atol=tolerance)


@pytest.mark.parametrize("name", FROM_MODELS)
def test_an_uninformative_action_has_no_gain(name, rows):
    gain = ESTIMATORS[name](Everything(), rows, PRIOR).mean(1)
    assert float(gain[0]) == pytest.approx(0.0, abs=1e-6)
    assert float(gain[2]) > 0.5


@pytest.mark.parametrize("name", FROM_MODELS)
def test_missing_rows_are_left_out(name, rows):
    missing = torch.zeros(3, 128).bool()
    missing[1, ::2] = True
    x = rows.x.masked_fill(missing[..., None], torch.nan)
    gain = ESTIMATORS[name](Everything(), replace(rows, x=x, missing=missing), PRIOR)
    assert torch.equal(gain.isnan(), missing)
    whole = ESTIMATORS[name](Everything(), rows, PRIOR).mean(1)
    assert torch.allclose(gain.nanmean(1)[[0, 2]], whole[[0, 2]], atol=0.05)
    assert abs(float(gain[1].nanmean() - whole[1])) < 0.5
    missing[1] = True  # all of them
    gain = ESTIMATORS[name](Everything(), replace(rows, x=x, missing=missing), PRIOR)
    assert gain[1].isnan().all()
    assert gain[2].isfinite().all()


@pytest.mark.parametrize("name", sorted(set(FROM_MODELS) - {"posterior"}))
def test_a_model_that_cannot_say_is_an_error(name, rows):
    """A loss that the model does not know is refused, not dropped."""
    x = rows.x.clone()
    x[1, 3] = torch.nan
    with pytest.raises(ValueError, match="outcome without a measurement is, x = NaN"):
        ESTIMATORS[name](Everything(), replace(rows, x=x), PRIOR)
    model = object()
    with pytest.raises(ValueError, match=r"expected a model with log_\w+ for \w+Gain"):
        ESTIMATORS[name](model, rows, PRIOR)


# Gains by a posterior that is exact, too wide, or has no density


@pytest.mark.parametrize("spread", [1.0, 2.0])
def test_a_model_of_the_wrong_spread_loses_what_the_divergence_says(spread):
    """E U = I - KL(N(m, s) || N(m, (k s)^2)) in each of two dimensions."""
    rows = candidates(ACTIONS, 4_000)
    gain = design.PosteriorGain()(ExactModel(spread=spread), rows, PRIOR)
    loss = 2 * (math.log(spread) + 0.5 / spread**2 - 0.5)
    error = gain.std(1) / gain.shape[1] ** 0.5
    distance = (gain.mean(1) - (information(rows.action) - loss)).abs()
    assert (distance <= 4 * error + 1e-6).all()


def test_outcomes_without_a_density_are_not_left_out_of_the_mean():
    class Overflows(ExactModel):
        def log_posterior(self, theta, x, action):
            return torch.where(theta[:, 0] > 0, torch.nan, theta[:, 0])

    with pytest.raises(ValueError, match=r"densities of Overflows; got NaN at"):
        design.PosteriorGain()(Overflows(), candidates(ACTIONS, 64), PRIOR)


# Interpolated noise-free outcomes


def test_draws_that_are_all_alike_have_their_outcome():
    # As those of a belief that has collapsed to a draw.
    theta = torch.full((60, 3), 0.37).double()
    mean = torch.full((60, 4), 2.0).double()
    emulator = MeanEmulator.fit(theta, mean)
    torch.testing.assert_close(emulator(emulator.knots), mean)
