"""Surrogate likelihoods and ratios, and the product of them over the trials."""

import pickle
import re
import warnings

import numpy as np
import pytest
import torch
from sbi.inference.potentials import likelihood_estimator_based_potential
from sbi.utils import BoxUniform

from sbi_active import ALHI, MixtureDensity, SeqBED
from sbi_active.inference import LFIRE, SeqBED_LFIRE
from sbi_active.inference.beliefs.weighted import KernelBelief
from sbi_active.inference.models.factors import Product, trained_region
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from tests.linear_gaussian import DIM, PRIOR, divergence, moments, posterior, simulator

SETTINGS = MixtureDensity(hidden_features=(16,), num_iterations=100)
BOX = BoxUniform(-torch.ones(1), torch.ones(1))
ACTION, X = torch.tensor([[1.0], [3.0]]), torch.tensor([[0.7, -0.4], [1.5, -2.0]])


def rows(n=1_500, prior=PRIOR):
    theta, action = prior.sample((n,)), 0.5 + 3 * torch.rand(n, 1)
    return theta, simulator(theta, action), action


def trained(make=ALHI, data=None, prior=PRIOR, network=SETTINGS, **options):
    inference = make(prior, network, show_progress_bars=False, **options)
    theta, x, action = rows() if data is None else data
    inference.append_simulations(theta, x, action=action).train()
    return inference


def test_the_belief_is_the_product_over_the_history():
    inference = trained()
    inference.update(X[0], action=ACTION[0], seed=0)
    theta, x, action = rows(prior=inference.belief)
    inference.append_simulations(theta, x, action=action).train()
    belief = inference.update(X[1], action=ACTION[1], seed=1)
    exact = posterior(ACTION, X)
    # 1,350 rows fix a coefficient of f to .03 noise deviations; twice two trials.
    assert abs(divergence(belief, exact)) < 0.05
    sd = float(exact.stddev[0])
    assert belief.mean.tolist() == pytest.approx(exact.mean.tolist(), abs=0.15 * sd)
    # A belief of one trial alone is far from it.
    assert divergence(belief, posterior(ACTION[:1], X[:1])) > 0.5


def test_the_product_is_sbi_s_condition_on_theta():
    inference = trained()
    model = inference.build_posterior()
    trials = [Observation(*pair) for pair in zip(ACTION, X, strict=True)]
    coordinates = PriorCoordinates(PRIOR, np.random.default_rng(0))
    ours = Product(coordinates, model, trials)
    potential, _ = likelihood_estimator_based_potential(model.estimator, PRIOR, X)
    theirs = potential.condition_on_theta(ACTION, dims_global_theta=[0, 1])
    theta = PRIOR.sample((20,))
    with torch.no_grad():
        expected = theirs(theta, x_o=X).double()
        found = ours.log_factors(theta).tolist()
        assert found == pytest.approx(expected.tolist(), rel=1e-4, abs=1e-3)
        table = model.log_likelihood_table(X, theta, ACTION[0])
        row = model.log_likelihood(X[:1].expand(20, -1), theta, ACTION[:1])
    assert table[0].tolist() == pytest.approx(row.tolist(), abs=1e-4)


def test_where_no_network_was_trained_there_is_no_likelihood():
    """Of no rows at all, bounds of a belief cannot be checked."""
    box, rng = BoxUniform(-torch.ones(2), torch.ones(2)), np.random.default_rng(0)
    coordinates = PriorCoordinates(box, rng)
    region = trained_region(0.01 * rng.standard_normal((500, 2)), rng)
    before = KernelBelief(box, 0.01 * torch.randn(50, 2))
    product = Product(coordinates, None, [], region, before)
    assert np.isneginf(product.log_likelihood(np.full((3, 2), 0.9))).all()
    assert np.isfinite(product.log_likelihood(np.zeros((1, 2)))).all()


@pytest.mark.parametrize("posterior", ["importance", "kde"])
def test_a_belief_is_a_normalized_distribution_that_pickles(posterior):
    torch.manual_seed(0)
    theta, action = BOX.sample((1_000,)), torch.rand(1_000, 1)
    data = theta, theta * action + 0.1 * torch.randn(1_000, 1), action
    inference = trained(data=data, prior=BOX, posterior=posterior)
    belief = inference.update(torch.tensor([0.9]), action=torch.ones(1), seed=0)
    grid = torch.linspace(-1, 1, 1_001)[:, None]
    total = float(belief.log_prob(grid).exp().double().mean()) * 2
    # The normalizer rests on thousands of draws, .01 in its logarithm.
    assert total == pytest.approx(1, abs=0.05)
    assert belief.log_prob(torch.tensor([[1.01]])).item() == -torch.inf
    draws = belief.sample((2_000,))
    assert draws.dtype == torch.float32
    assert bool((draws.abs() <= 1).all())
    assert float(draws.mean()) == pytest.approx(float(belief.mean), abs=0.02)
    again = pickle.loads(pickle.dumps(belief))
    assert torch.equal(again.log_prob(grid), belief.log_prob(grid))


def falls(theta, action):
    """No measurement where theta exceeds a half."""
    x = theta + 0.1 * torch.randn_like(theta)
    return torch.where(theta > 0.5, torch.nan, x)


def test_no_measurement_is_information():
    torch.manual_seed(0)
    theta, action = BOX.sample((1_500,)), torch.rand(1_500, 1)
    inference = trained(data=(theta, falls(theta, action), action), prior=BOX)
    model = inference.build_posterior()
    drawn = model.sample(torch.tensor([[0.9]]).expand(500, 1), torch.zeros(1))
    assert float(drawn.isnan().double().mean()) > 0.95
    belief = inference.update(torch.tensor([torch.nan]), action=torch.ones(1), seed=0)
    share = float((belief.sample((2_000,)) > 0.5).double().mean())
    assert share > 0.9
    # The same outcome where none was ever missing tells nothing.
    theta = BOX.sample((500,))
    inference = trained(data=(theta, theta + 0.1, torch.ones(1)), prior=BOX)
    belief = inference.update(torch.tensor([torch.nan]), action=torch.ones(1), seed=0)
    assert abs(float(belief.mean)) < 0.1
    assert float(belief.variance) == pytest.approx(1 / 3, rel=0.1)


def raises(text, error=ValueError):
    return pytest.raises(error, match=re.escape(text))


def test_a_failed_update_leaves_the_trainer_as_it_was():
    inference = trained()
    num, network = len(inference._theta_roundwise), inference._neural_net

    def broken(theta, action):
        raise OSError("no license")

    with pytest.raises(Exception, match="no license"):
        inference.update(torch.zeros(2), action=torch.ones(1), simulator=broken, seed=0)
    assert inference.trials == []
    assert inference.belief is PRIOR
    assert len(inference._theta_roundwise) == num
    assert inference._neural_net is network
    inference.update(torch.zeros(2), action=torch.ones(1), seed=0)


def test_outcomes_measured_in_part_are_refused():
    theta, x, action = rows(50)
    x[3, 1] = torch.nan
    inference = ALHI(PRIOR, SETTINGS, show_progress_bars=False)
    with raises("got 1 of 50 measured in part, the first in row 3; leave out"):
        inference.append_simulations(theta, x, action=action)
    with raises("expected outcomes that are measured or NaN throughout"):
        trained().update(torch.tensor([0.0, torch.nan]), action=torch.ones(1))


# SeqBED: a logistic regression a parameter, and ratios that all parameters share


ACTIONS = torch.tensor([[0.5], [2.0]])
NORMAL = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))


def drawn(inference, n, prior=PRIOR):
    theta = prior.sample((n,))
    action = ACTIONS[torch.randint(2, (n,))]
    theta, action = inference.arrange(theta, action)
    return theta, simulator(theta, action), action


def log_ratio(theta, x, action):
    """Exact log p(x | theta, action) / p(x | action)."""
    scale = (1 + action**2).sqrt()
    own = torch.distributions.Normal(action * theta, 1.0).log_prob(x)
    return (own - torch.distributions.Normal(0.0, scale).log_prob(x)).sum(-1)


def test_lfire_meets_the_closed_form():
    """The log ratio of two Gaussians is quadratic in x, as the summaries are."""
    rng = np.random.default_rng(0)
    theta, n = 0.8, 4_000
    own = torch.from_numpy(theta + rng.standard_normal((n, 1)))
    marginal = torch.from_numpy(2**0.5 * rng.standard_normal((n, 1)))
    settings = LFIRE()
    scaling = torch.zeros(1), torch.ones(1)
    psi = [settings.summaries(x, *scaling).numpy() for x in (own, marginal)]
    ratio = settings.fit(*psi, seed=0)
    x = torch.linspace(-1.5, 2.5, 9)[:, None]
    found = settings.summaries(x, *scaling).numpy() @ ratio[:-1] + ratio[-1]
    exact = log_ratio(torch.tensor([[theta]]), x, torch.ones(1, 1))
    # A coefficient of 8,000 rows is known to about .05.
    assert np.abs(found - exact.numpy()).max() < 0.2
    assert np.abs(found).max() > 0.5


def test_seqbed_weighs_particles():
    torch.manual_seed(0)
    inference = SeqBED_LFIRE(NORMAL, num_particles=20)
    theta, x, action = drawn(inference, 2_000, NORMAL)
    model = inference.append_simulations(theta, x, action=action).train()
    own = model.belief.sample((2_000,))
    rows = simulator(own, ACTIONS[1:].expand(2_000, 1))
    found = model.log_ratio(own, rows, ACTIONS[1:].expand(2_000, 1))
    exact = log_ratio(own, rows, ACTIONS[1:])
    # 50 rows a particle: a third of a nat apart, .1 on average over 20 particles.
    assert float(found.mean()) == pytest.approx(float(exact.mean()), abs=0.3)
    x_o = torch.tensor([1.6])
    belief = inference.update(x_o, action=ACTIONS[1])
    mean, variance = moments(x_o, ACTIONS[1])
    # Of 20 particles half a dozen count.
    sd = float(variance.sqrt())
    assert float(belief.mean) == pytest.approx(float(mean), abs=3 * sd / 6**0.5)
    effective = belief.diagnostics.effective_sample_size
    assert 2 < effective < 15
    # The kernels add h^2 of the particles' own variance.
    assert 0.7 * sd < float(belief.variance.sqrt()) < 2 * sd
    assert len(inference.trials) == 1
    again = pickle.loads(pickle.dumps(belief))
    assert torch.equal(again.log_prob(theta), belief.log_prob(theta))


def test_amortized_ratios_meet_the_closed_form():
    classifier = RatioClassifier(hidden_features=(32,), num_iterations=100)
    theta, x, action = data = rows(2_000)
    inference = trained(SeqBED, data, network=classifier)
    model = inference.build_posterior()
    with torch.no_grad():
        error = model.log_ratio(theta, x, action) - log_ratio(theta, x, action)
    assert abs(float(error.mean())) < 0.15
    assert float(error.abs().median()) < 0.25
    x_o = torch.tensor([0.7, -0.4])
    belief = inference.update(x_o, action=torch.ones(1), seed=0)
    mean, variance = moments(x_o, torch.ones(1))
    sd = float(variance[0].sqrt())
    assert belief.mean.tolist() == pytest.approx(mean.tolist(), abs=0.25 * sd)
    assert belief.variance.sqrt().tolist() == pytest.approx([sd] * DIM, rel=0.2)


def test_what_had_the_name_still_works_and_a_warning_says_the_new_one():
    for further, named in (((LFIRE(),), {}), ((), {"num_particles": 5})):
        with pytest.warns(DeprecationWarning, match="use .*inference.SeqBED_LFIRE"):
            former = SeqBED(NORMAL, *further, **named)
        assert type(former) is SeqBED_LFIRE
    assert former._num_particles == 5
    rows = NORMAL.sample((3,)), torch.ones(3, 1)
    with pytest.warns(FutureWarning, match=r"as SeqBED_C did.*SeqBED_LFIRE\(prior\)"):
        assert SeqBED(NORMAL).arrange(*rows) == rows
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sbi's, of what pickled trainers lose
        warnings.simplefilter("error", FutureWarning)
        for classifier in (None, RatioClassifier()):
            inference = SeqBED(NORMAL, classifier)
            assert type(pickle.loads(pickle.dumps(inference))) is SeqBED
            assert inference.arrange(*rows) == rows
