"""Outcomes of several actions together, where information has a closed form."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal, Normal

from sbi_active.design import LikelihoodGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.outcomes import (
    JointLikelihood,
    conditional_gain,
    join_outcomes,
)

PRIOR = MultivariateNormal(torch.zeros(1), torch.eye(1))


class Slope:
    """x = action * theta + e with e ~ N(0, 1), as an exact likelihood."""

    exact_likelihood = True

    def log_likelihood(self, x, theta, action):
        return Normal(action * theta, 1.0).log_prob(x).sum(-1)


def simulated(action, theta, seed):
    generator = torch.Generator().manual_seed(seed)
    mean = action[:, None] * theta
    x = mean + torch.randn(mean.shape, generator=generator)
    return CandidateSimulations(theta, action, x, mean)


def test_what_an_action_tells_beyond_others_has_a_closed_form():
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(4_000, 1, generator=generator)
    action, others = torch.tensor([[0.5], [2.0]]), torch.tensor([[1.0], [1.5]])
    joint = join_outcomes(simulated(action, theta, 1), simulated(others, theta, 2))
    estimator = LikelihoodGain(num_contrastive=1_000)
    gain = conditional_gain(estimator, JointLikelihood(Slope(), 1), joint, PRIOR, 2)
    known = 1 + float(others.square().sum())
    exact = [0.5 * math.log1p(a**2 / known) for a in (0.5, 2.0)]
    assert gain.mean(1).tolist() == pytest.approx(exact, abs=0.04)
