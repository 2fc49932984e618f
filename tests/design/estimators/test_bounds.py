"""Estimators from a likelihood or a ratio against the linear-Gaussian closed form.

Tolerances are three of an estimate's own standard errors, and where an estimator has a
bias it must lie on the side that is claimed.
"""

import math

import pytest
import torch

from sbi_active.design import LikelihoodGain, RatioGain
from sbi_active.design.estimators.base import standard_error
from sbi_active.design.estimators.contrast import InfoNCEGain
from tests.design.test_outcomes import PRIOR as FRAGILE_PRIOR
from tests.design.test_outcomes import Fragile, log_normal
from tests.linear_gaussian import (
    PRIOR,
    ExactLikelihood,
    ExactRatio,
    candidates,
    information,
)

ACTIONS = torch.tensor([[0.0], [0.5], [1.0], [2.0]])
EXACT = information(ACTIONS)
FAR = torch.tensor([[20.0]])  # 6 nats
ROWS, FAR_ROWS = candidates(ACTIONS, 512), candidates(FAR, 512)
ESTIMATORS = {
    "likelihood": (LikelihoodGain(num_contrastive=500), ExactLikelihood()),
    "info_nce, ratio": (InfoNCEGain(num_contrastive=255), ExactRatio()),
    "info_nce, likelihood": (InfoNCEGain(num_contrastive=255), ExactLikelihood()),
    "ratio": (RatioGain(), ExactRatio()),
}


def estimate(estimator, model, simulations, belief=PRIOR):
    gain = estimator(model, simulations, belief)
    return gain.mean(1), standard_error(gain)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_closed_form(name):
    estimator, model = ESTIMATORS[name]
    gain, error = estimate(estimator, model, ROWS)
    assert ((gain - EXACT).abs() <= 3 * error + 1e-6).all()
    assert (error < 0.1).all()


def test_bounds_are_where_they_claim_to_be():
    """Six nats are too many for 100 draws."""
    exact, model = float(information(FAR)), ExactLikelihood()
    upper, error = estimate(LikelihoodGain(num_contrastive=100), model, FAR_ROWS)
    assert float(upper) > exact + 3 * float(error)
    gain, error = estimate(InfoNCEGain(), model, FAR_ROWS)
    assert float(gain) < exact - 3 * float(error)
    assert InfoNCEGain().bound_on(model) == "lower"


@pytest.mark.parametrize("spread", [0.5, 2.0])
def test_a_wrong_likelihood_is_wrong(spread):
    """Negative control. With a spread s, log q - log E q is known in closed form.

    It is below the information by the divergence of the implied posterior; with few
    draws it is above: no bound on either side.
    """
    model, a = ExactLikelihood(spread), ACTIONS[:, 0].double()
    gain, error = estimate(LikelihoodGain(num_contrastive=2_000), model, ROWS)
    wide = a**2 + spread**2
    own = -1 / spread**2 - 2 * math.log(spread)
    wrong = own + (a**2 + 1) / wide + wide.log()
    assert ((gain - wrong).abs() <= 3 * error + 0.02)[:3].all()
    assert (gain < EXACT - 3 * error)[1:].all()
    few, error = estimate(LikelihoodGain(num_contrastive=20), model, FAR_ROWS)
    assert float(few) > float(information(FAR) + 3 * error)
    # a bound for any likelihood stays below for all that
    gain, error = estimate(InfoNCEGain(), model, ROWS)
    assert (gain < EXACT + 3 * error + 1e-6).all()
    assert float(gain[-1]) < float(EXACT[-1] - 3 * error[-1])


def test_a_wrong_ratio_is_wrong_but_for_info_nce():
    """Off by a function of x, its mean is above; InfoNCE does not see it."""
    model = ExactRatio(offset=0.5)
    gain, error = estimate(RatioGain(), model, ROWS)
    assert (gain > EXACT + 3 * error).all()
    blind = InfoNCEGain()(model, ROWS, PRIOR)
    assert torch.allclose(blind, InfoNCEGain()(ExactRatio(), ROWS, PRIOR))
    # a steep ratio fools the mean, and only loosens the bound
    steep = ExactRatio(power=1.8)
    gain, error = estimate(RatioGain(), steep, ROWS)
    assert (gain > EXACT + 3 * error)[1:].all()
    gain, error = estimate(InfoNCEGain(), steep, ROWS)
    assert (gain < EXACT + 3 * error + 1e-6).all()


class FragileLikelihood:
    """Measurements or none, with their exact likelihood."""

    exact_likelihood = True

    def __init__(self, luck):
        self.world = Fragile(luck)

    def log_likelihood(self, x, theta, action):
        log_v = self.world.log_valid(theta.double(), action.double())
        lost = torch.log1p(-log_v.exp().clamp_max(1 - 1e-12))
        measured = log_v + log_normal(x - action * theta)
        return torch.where(x.isnan(), lost, measured)[:, 0]


@pytest.mark.parametrize("luck", [0.0, 0.4])
@pytest.mark.parametrize(
    "estimator", [LikelihoodGain(num_contrastive=500), InfoNCEGain(num_contrastive=511)]
)
def test_outcomes_without_a_measurement_are_information(estimator, luck):
    model = FragileLikelihood(luck)
    simulations = model.world.simulations(512, 0)
    gain, error = estimate(estimator, model, simulations, FRAGILE_PRIOR)
    exact = model.world.exact()
    assert ((gain - exact["counted"]).abs() < 3 * error + 0.01).all()
    assert ((gain - exact["dropped"]).abs() > 3 * error).any()  # negative control
