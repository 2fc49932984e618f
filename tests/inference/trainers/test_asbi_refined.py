"""Updates with a simulator: the posterior of all trials from the original prior."""

import warnings

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active import ASBI, MixtureDensity, RefinementOptions
from sbi_active.inference.beliefs.belief import compare
from sbi_active.inference.rounds.rows import Observation
from tests.linear_gaussian import PRIOR, simulator

TRIALS = [
    Observation(torch.tensor([2.0]), torch.tensor([1.0, -1.5])),
    Observation(torch.tensor([1.0]), torch.tensor([0.2, 0.1])),
    Observation(torch.tensor([3.0]), torch.tensor([1.2, -2.0])),
]
SETTINGS = RefinementOptions(num_histories=600)
COST = 0.1  # nats: four times what 600 noisy histories cost in the mean of 24 seeds


def exact(trials):
    """Precision 1 + sum a^2, mean sum a x / precision."""
    precision = 1 + sum(t.action**2 for t in trials)
    mean = sum(t.action * t.x for t in trials) / precision
    return MultivariateNormal(mean, torch.eye(2) / precision)


def divergence(belief, truth):
    theta = truth.sample((4_000,))
    return float((truth.log_prob(theta) - belief.log_prob(theta)).mean())


def test_errors_of_a_chained_belief_do_not_stay():
    """A wrong belief in between: chained it would stay, refined it is gone."""
    wrong = MultivariateNormal(torch.tensor([2.0, 2.0]), 0.01 * torch.eye(2))
    inference = ASBI(PRIOR, MixtureDensity(hidden_features=(16,), num_iterations=100))
    theta, action = wrong.sample((500,)), 3 * torch.rand(500, 1)
    x = simulator(theta, action)
    inference.append_simulations(theta, x, action=action, belief=wrong).train()
    trial = TRIALS[0]
    belief = inference.update(
        trial.x, action=trial.action, simulator=simulator, refinement=SETTINGS, seed=0
    )
    assert divergence(belief, exact(TRIALS[:1])) < COST
    assert belief.diagnostics.chained_loss > 5


def test_update_all_starts_from_scratch_and_order_does_not_matter():
    inference = ASBI(PRIOR)
    inference.update(torch.ones(2), action=torch.ones(1), simulator=simulator, seed=0)
    beliefs = [
        inference.update_all(trials, simulator, refinement=SETTINGS, seed=1)
        for trials in (TRIALS, TRIALS[::-1])
    ]
    assert inference.trials == TRIALS[::-1]
    for belief in beliefs:
        assert divergence(belief, exact(TRIALS)) < COST


def hides(theta, action):
    """No measurement where the first parameter is above .5."""
    return torch.where(theta[:, :1] > 0.5, torch.nan, simulator(theta, action))


def test_invalid_trials_count_whatever_their_place():
    """Known to 1 / sqrt(15) around .35 by measurements; above .5, by one without."""
    measured = [Observation(t.action, torch.tensor([0.4, -0.7])) for t in TRIALS[:1]]
    invalid = Observation(torch.tensor([1.0]), torch.full((2,), torch.nan))
    # Contradictory but for chance: measurements say below .5, the other above.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inference = ASBI(PRIOR)
        belief = inference.update_all([invalid], hides, seed=0)
    # .988 in the mean of ten seeds: who measures is regressed as well.
    assert float((belief.sample((2_000,))[:, 0] > 0.5).float().mean()) > 0.975
    for trials in ([invalid, *measured], [*measured, invalid]):
        both = inference.update_all(trials, hides, refinement=SETTINGS, seed=0)
        assert not both.diagnostics.trustworthy  # no parameter explains both


class _Network:
    """A stand-in for a chained belief: the exact posterior, scaled and moved."""

    def __init__(self, spread, shift=0.0):
        mean, cov = exact(TRIALS).mean, exact(TRIALS).covariance_matrix
        self.normal = MultivariateNormal(mean + shift, spread**2 * cov)

    def sample(self, shape):
        return self.normal.sample(shape)

    def log_prob(self, theta):
        return self.normal.log_prob(theta)


@pytest.mark.parametrize(
    ("network", "kind"),
    [
        (_Network(6.0), "under-confident"),
        (_Network(0.2), "overconfident"),
        (_Network(1.0, shift=1.0), "misplaced"),
        (_Network(1.1), None),
    ],
)
def test_a_blunt_and_an_overconfident_network_are_told_apart(network, kind):
    """Blunt by a factor 6 in two dimensions: 2 log 6 = 3.6 nats of entropy."""
    belief = ASBI(PRIOR).update_all(TRIALS, simulator, refinement=SETTINGS, seed=0)
    compare(belief, network)
    warnings = belief.diagnostics.network_warnings
    if kind is None:
        assert not warnings
    else:
        assert kind in warnings[0]
    if kind == "under-confident":
        expected = 2 * torch.tensor(6.0).log()
        assert abs(belief.diagnostics.chained_bluntness - expected) < 0.3
