"""ASBI: rounds with actions, Algorithm 1, and updates from the original prior."""

import pickle
import re
import warnings

import pytest
import torch
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform, RestrictedPrior, get_density_thresholder
from torch.distributions import Distribution, MultivariateNormal

from sbi_active import ASBI, Belief, MixtureDensity, RefinementOptions
from sbi_active.inference import ActionEmbedding, ActionPosterior
from sbi_active.inference.beliefs.belief import compare
from sbi_active.inference.rounds.rows import Observation
from tests import linear_gaussian
from tests.linear_gaussian import DIM, PRIOR, divergence, moments, simulator

SMALL = MixtureDensity(hidden_features=(32, 32), num_components=2, num_iterations=600)
QUICK = MixtureDensity(hidden_features=(8,), num_iterations=20)
BOX = BoxUniform(-2 * torch.ones(DIM), 2 * torch.ones(DIM))


def rows_of(n=1_000, prior=PRIOR):
    theta, action = prior.sample((n,)), 3 * torch.rand(n, 1)
    return theta, simulator(theta, action), action


def trained(density_estimator=SMALL, prior=PRIOR, n=1_000, data=None, **train):
    theta, x, action = rows_of(n, prior) if data is None else data
    inference = ASBI(prior, density_estimator, show_progress_bars=False)
    inference.append_simulations(theta, x, action=action).train(**train)
    return inference


def test_the_posterior_meets_the_closed_form_at_every_action():
    settings = MixtureDensity(hidden_features=(32, 32), num_iterations=600)
    posterior = trained(settings, n=4_000).build_posterior()
    theta, x, action = rows_of(4_000)
    mean, variance = moments(x, action)
    exact = torch.distributions.Normal(mean, variance.sqrt()).log_prob(theta).sum(1)
    gap = exact - posterior.log_posterior(theta, x, action)
    assert float(gap.mean()) < 0.08  # KL to the exact posterior, nats
    low = action[:, 0] < 1.5
    assert float(gap[low].mean()) < 0.1
    assert float(gap[~low].mean()) < 0.1
    # negative control: the posterior with the actions mixed up is far off
    wrong = posterior.log_posterior(theta, x, action[torch.randperm(len(action))])
    assert float((exact - wrong).mean()) > 0.3


def test_two_rounds_chain_to_the_exact_posterior():
    settings = MixtureDensity(hidden_features=(32, 32), num_iterations=400)
    inference, belief = ASBI(PRIOR, settings, show_progress_bars=False), PRIOR
    for trial in TRIALS[:2]:
        theta = belief.sample((3_000,))
        xi = 3 * torch.rand(len(theta), 1)
        rows = theta, simulator(theta, xi)
        inference.append_simulations(*rows, action=xi, belief=belief).train()
        belief = inference.update(trial.x, action=trial.action)
    assert belief.label == "chained approximation"
    truth = exact(inference.trials)
    # Errors of a network of this size, a tenth of the posterior's sd of .41
    assert torch.allclose(belief.mean, truth.mean, atol=0.08)
    assert torch.allclose(belief.variance.sqrt(), truth.stddev, atol=0.05)


def test_invalid_rows_are_kept_by_ours_and_dropped_for_sbi_s():
    theta, x, action = rows_of(1_500)
    x[theta[:, 0] > 1] = torch.nan
    inference = ASBI(PRIOR, SMALL)
    inference.append_simulations(theta, x, action=action).train()
    assert len(inference.get_simulations()[0]) == 1_500
    belief = inference.update(torch.full((2,), torch.nan), action=torch.ones(1))
    assert float(belief.mean[0]) > 0.8  # E[theta_1 | theta_1 > 1] = 1.53
    inference = ASBI(PRIOR, "mdn", show_progress_bars=False)
    with pytest.warns(UserWarning, match="simulations without a measurement"):
        inference.append_simulations(theta, x, action=action)
    assert len(inference.get_simulations()[0]) == int((theta[:, 0] <= 1).sum())
    with pytest.warns(UserWarning, match="Maximum number of epochs"):
        inference.train(max_num_epochs=1)
    before = inference.belief
    with pytest.warns(UserWarning, match="has never seen an outcome like"):
        belief = inference.update(torch.full((2,), torch.nan), action=torch.ones(1))
    assert belief.label == "unchanged"
    draws = belief.sample((10,))
    assert torch.equal(belief.log_prob(draws), before.log_prob(draws))


def test_the_posterior_takes_outcomes_without_a_measurement():
    """x is missing where theta_1 > 1, its second number alone where theta_2 > 1."""
    theta, x, action = rows_of(3_000)
    complete = x.clone()
    x[theta[:, 0] > 1] = torch.nan
    x[theta[:, 1] > 1, 1] = torch.nan
    posterior = trained(SMALL, data=(theta, x, action)).build_posterior()
    assert isinstance(posterior, ActionPosterior)
    none, part = torch.full((2,), torch.nan), torch.tensor([0.3, torch.nan])
    draws = posterior.sample((500,), x=none, action=torch.ones(1))
    assert float(draws[:, 0].mean()) > 0.8  # E[theta_1 | theta_1 > 1] = 1.53
    draws = posterior.sample((500,), x=part, action=torch.ones(1))
    assert float(draws[:, 1].mean()) > 0.8
    both = torch.stack([part, torch.tensor([0.3, 0.1]), none])
    batched = posterior.sample_batched((400,), x=both, action=torch.ones(3, 1))
    assert (batched.mean(0)[:, 1] > 0.8).tolist() == [True, False, False]
    at = [{"x": row, "action": torch.ones(1)} for row in both]
    single = torch.stack([posterior.log_prob(draws[:5], **one) for one in at], 1)
    three = draws[:5, None].expand(5, 3, 2)
    batch = posterior.log_prob_batched(three, both, torch.ones(3, 1))
    assert torch.allclose(batch, single, atol=1e-4)
    assert posterior.sample((), **at[1]).shape == (2,)
    best = posterior.map(num_iter=5, num_to_optimize=5, **at[2])
    assert float(best.reshape(-1)[0]) > 0.5
    # the same network, had it seen complete rows_of alone, says so
    data = tuple(rows_of[:300] for rows_of in (theta, complete, action))
    other = trained(QUICK, data=data).build_posterior()
    with pytest.warns(UserWarning, match="has never seen an outcome like this"):
        other.sample((2,), **at[2])


def test_images_pass_through_an_embedding():
    theta = BOX.sample((400,))
    action = torch.rand(400, 2)
    image = theta.sum(1)[:, None, None, None] * torch.ones(1, 6, 6)
    image = image + 0.1 * torch.randn(400, 1, 6, 6)
    cnn = torch.nn.Sequential(torch.nn.Conv2d(1, 2, 3), torch.nn.Flatten())
    embedding = ActionEmbedding(cnn, (1, 6, 6), 2)
    ours = MixtureDensity(embedding_net=embedding, num_iterations=50)
    for estimator in (posterior_nn("mdn", embedding_net=embedding), ours):
        inference = ASBI(BOX, estimator, show_progress_bars=False)
        inference.append_simulations(theta, image, action=action)
        inference.train(max_num_epochs=2)
        posterior = inference.build_posterior()
        draws = posterior.sample((3,), x=image[0], action=action[0])
        assert draws.shape == (3, 2)
        assert posterior.at(action[0]).sample((3,), x=image[:1]).shape == (3, 2)


def test_belief_is_a_distribution():
    inference = trained(QUICK, prior=BOX)
    belief = inference.update(torch.tensor([1.5, -1.5]), action=torch.tensor([1.0]))
    assert isinstance(belief, Distribution)
    assert isinstance(belief, Belief)
    assert belief.batch_shape == ()
    assert belief.event_shape == (2,)
    assert belief.sample().shape == (2,)
    assert belief.sample((3, 4)).shape == (3, 4, 2)
    assert belief.sample((3,)).dtype == torch.float32
    assert belief.log_prob(torch.rand(3, 4, 2, dtype=torch.float64)).shape == (3, 4)
    assert belief.log_prob(torch.tensor([2.1, 0.0])) == -torch.inf
    assert (belief.sample((2_000,)).abs() <= 2).all()
    # normalized over the support: the mean of density times volume under uniform draws
    density = belief.log_prob(BOX.sample((100_000,))).double().exp() * 16
    error = density.std() / 100_000**0.5
    assert abs(density.mean() - 1) < 4 * error + 0.02  # .02: the normalizer's own error
    again = pickle.loads(pickle.dumps(belief))
    theta = belief.sample((5,))
    assert torch.equal(again.log_prob(theta), belief.log_prob(theta))


def test_truncated_proposals_of_the_belief_pass_and_others_do_not():
    theta, x, action = rows_of(200, BOX)
    inference = trained(QUICK, prior=BOX)
    packed = inference.build_posterior().packed()
    packed.set_default_x(torch.tensor([[0.0, 0.0, 1.0]]))
    region = get_density_thresholder(packed, num_samples_to_estimate_support=10_000)
    restricted = RestrictedPrior(BOX, region)
    inference.append_simulations(theta, x, proposal=restricted, action=action)
    with pytest.raises(ValueError, match="expected proposal to be the belief"):
        inference.append_simulations(theta, x, proposal=packed, action=action)


# Bad input gets a clear error that says what to do


def raises(text, error=ValueError):
    return pytest.raises(error, match=re.escape(text))


def test_rounds_with_and_without_action_do_not_mix():
    theta, x, action = rows_of(50)
    with raises("expected action=, since belief= was given"):
        ASBI(PRIOR).append_simulations(theta, x, belief=PRIOR)
    inference = ASBI(PRIOR, "mdn").append_simulations(theta, x)
    with raises("start a new ASBI(prior) for rounds with actions"):
        inference.append_simulations(theta, x, action=action)


def test_what_a_trained_round_refuses():
    theta, x, action = rows_of(50)
    inference = ASBI(PRIOR, QUICK, show_progress_bars=False)
    inference.append_simulations(theta, x, action=action)
    with raises("expected a network trained under the current belief", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))
    with raises("expected resume_training after train() on the same rows"):
        inference.train(resume_training=True)
    inference.train()
    with raises("expected action of shape (1, 1) or (1,); got (3,)"):
        inference.update(torch.zeros(2), action=torch.zeros(3))
    with raises("expected one outcome; got 2 rows"):
        inference.update(torch.zeros(2, 2), action=torch.zeros(1))
    posterior = inference.build_posterior()
    with raises("expected x= and action= together; got x without action"):
        posterior.sample((3,), x=torch.zeros(2))
    inference.update(torch.zeros(2), action=torch.zeros(1))
    with raises("append simulations of the belief with action=", RuntimeError):
        inference.update(torch.zeros(2), action=torch.zeros(1))


# Updates with a simulator: the posterior of all trials from the original prior


TRIALS = [
    Observation(torch.tensor([2.0]), torch.tensor([1.0, -1.5])),
    Observation(torch.tensor([1.0]), torch.tensor([0.2, 0.1])),
    Observation(torch.tensor([3.0]), torch.tensor([1.2, -2.0])),
]
REFINEMENT = RefinementOptions(num_histories=600)
COST = 0.1  # nats: four times what 600 noisy histories cost in the mean of 24 seeds


def exact(trials):
    action, x = (torch.stack([getattr(t, v) for t in trials]) for v in ("action", "x"))
    return linear_gaussian.posterior(action, x)


def test_errors_of_a_chained_belief_do_not_stay():
    """A wrong belief in between: chained it would stay, refined it is gone."""
    wrong = MultivariateNormal(torch.tensor([2.0, 2.0]), 0.01 * torch.eye(2))
    inference = ASBI(PRIOR, MixtureDensity(hidden_features=(16,), num_iterations=100))
    theta, action = wrong.sample((500,)), 3 * torch.rand(500, 1)
    x = simulator(theta, action)
    inference.append_simulations(theta, x, action=action, belief=wrong).train()
    told = {"simulator": simulator, "refinement": REFINEMENT, "seed": 0}
    belief = inference.update(TRIALS[0].x, action=TRIALS[0].action, **told)
    assert divergence(belief, exact(TRIALS[:1])) < COST
    assert belief.diagnostics.chained_loss > 5


def test_update_all_starts_from_scratch_and_order_does_not_matter():
    inference = ASBI(PRIOR)
    inference.update(torch.ones(2), action=torch.ones(1), simulator=simulator, seed=0)
    for trials in (TRIALS, TRIALS[::-1]):
        given = {"refinement": REFINEMENT, "seed": 1}
        belief = inference.update_all(trials, simulator, **given)
        assert inference.trials == trials
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
        both = inference.update_all(trials, hides, refinement=REFINEMENT, seed=0)
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


#: Networks, and what they are.
NETWORKS = [
    (_Network(6.0), "under-confident"),
    (_Network(0.2), "overconfident"),
    (_Network(1.0, shift=1.0), "misplaced"),
    (_Network(1.1), None),
]


@pytest.mark.parametrize(("network", "kind"), NETWORKS)
def test_a_blunt_and_an_overconfident_network_are_told_apart(network, kind):
    """Blunt by a factor 6 in two dimensions: 2 log 6 = 3.6 nats of entropy."""
    belief = ASBI(PRIOR).update_all(TRIALS, simulator, refinement=REFINEMENT, seed=0)
    compare(belief, network)
    warnings = belief.diagnostics.network_warnings
    if kind is None:
        assert not warnings
    else:
        assert kind in warnings[0]
    if kind == "under-confident":
        expected = 2 * torch.tensor(6.0).log()
        assert abs(belief.diagnostics.chained_bluntness - expected) < 0.3
