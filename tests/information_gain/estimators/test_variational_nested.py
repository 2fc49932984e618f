"""A trained posterior as the proposal, with a prior whose edges it leaks over."""

import torch
from sbi.utils import BoxUniform
from torch.distributions import Normal

from sbi_active import ASBI, MixtureDensity
from sbi_active.information_gain import (
    CandidateSimulations,
    PosteriorGain,
    VariationalNestedGain,
)
from sbi_active.information_gain.race import standard_error

PRIOR = BoxUniform(-torch.ones(1), torch.ones(1))
ACTIONS = torch.tensor([[1.0], [4.0]])
SMALL = MixtureDensity(hidden_features=(16,), num_iterations=60)


class Likelihood:
    exact_likelihood = True

    def log_likelihood(self, x, theta, action):
        return Normal(action * theta, 1.0).log_prob(x)[:, 0]


def exact(action):
    """Entropy of a uniform number with Gaussian noise, less that of the noise."""
    a = float(action)
    x = torch.linspace(-a - 8, a + 8, 20_001).double()
    cdf = Normal(0.0, 1.0).cdf
    density = (cdf(x + a) - cdf(x - a)) / (2 * a)
    entropy = -torch.special.xlogy(density, density).sum() * (x[1] - x[0])
    return float(entropy - Normal(0.0, 1.0).entropy())


def test_a_network_that_leaks_is_a_valid_proposal():
    theta, action = PRIOR.sample((1_000,)), 1 + 3 * torch.rand(1_000, 1)
    x = action * theta + torch.randn_like(theta)
    inference = ASBI(PRIOR, SMALL, show_progress_bars=False)
    inference.append_simulations(theta, x, action=action, belief=PRIOR).train()
    posterior = inference.build_posterior()

    theta = PRIOR.sample((1_000,))
    x = ACTIONS[:, None] * theta + torch.randn(2, 1_000, 1)
    rows = CandidateSimulations(theta, ACTIONS, x)
    information = torch.tensor([exact(a) for a in ACTIONS]).double()
    draws = posterior.packed().posterior_estimator.sample(
        torch.Size([8]), condition=torch.cat([x[1], ACTIONS[1].expand(1_000, 1)], 1)
    )
    assert float((draws.abs() > 1).double().mean()) > 0.02  # it leaks

    upper = VariationalNestedGain(posterior)(Likelihood(), rows, PRIOR)
    lower = PosteriorGain()(posterior, rows, PRIOR)
    error = torch.stack([standard_error(row) for row in upper])
    assert ((upper.mean(1) - information).abs() < 3 * error).all()
    slack = (upper - lower).mean(1)  # paired, so the draws hardly matter
    assert (slack > 0.01).all()

    class Misreporting:
        """Negative control: draws that are not of the density that is reported."""

        sample_batched = posterior.sample_batched

        def log_posterior(self, theta, x, action):
            return posterior.log_posterior(theta, x, action) + 0.7

    wrong = VariationalNestedGain(Misreporting())(Likelihood(), rows, PRIOR)
    assert (wrong.mean(1) > information + 3 * error).all()
