"""Draws from a refined belief."""

from dataclasses import replace

import numpy as np
import torch
from sbi.utils import BoxUniform

from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.sampling.coordinates import PriorCoordinates


def test_a_normalizer_that_fresh_draws_do_not_have_ends_in_resampling():
    prior = BoxUniform(-4 * torch.ones(1), 4 * torch.ones(1))
    coordinates = PriorCoordinates(prior, np.random.default_rng(0))

    class Normal:
        def __init__(self):
            self.coordinates = coordinates

        def log_likelihood(self, z):
            return -0.5 * (coordinates.to_theta(z).double().numpy()[:, 0] / 0.3) ** 2

    fit = learned_fit(Normal(), np.random.default_rng(0))
    assert fit is not None
    # As if one draw that no other resembles had most of the weight.
    far = replace(fit.fit, log_evidence=fit.fit.log_evidence + 24.0)
    belief = LearnedBelief(prior, replace(fit, fit=far), defensive=0.01)
    draws = belief.sample((2_000,))[:, 0]
    assert len(draws) == 2_000
    # 1 % are of the prior, whose standard deviation is 2.3.
    spread = (0.99 * 0.3**2 + 0.01 * 64 / 12) ** 0.5
    assert abs(float(draws.std()) - spread) < 0.1
