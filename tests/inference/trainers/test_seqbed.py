"""SeqBED: a logistic regression a parameter, and ratios that all parameters share."""

import pickle
import warnings

import numpy as np
import pytest
import torch

from sbi_active import SeqBED, SeqBED_B
from sbi_active.inference import LFIRE, SeqBED_LFIRE
from sbi_active.inference.networks.ratio_network import RatioClassifier
from tests.linear_gaussian import DIM, PRIOR, moments, simulator

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


@pytest.mark.parametrize(
    ("trainer", "classifier"),
    [
        pytest.param(SeqBED_B, None, marks=pytest.mark.slow),
        (SeqBED, RatioClassifier(hidden_features=(32,), num_iterations=150)),
    ],
)
def test_amortized_ratios_meet_the_closed_form(trainer, classifier):
    torch.manual_seed(0)
    inference = trainer(PRIOR, classifier, show_progress_bars=False)
    n = 3_000
    theta, action = PRIOR.sample((n,)), 0.5 + 2 * torch.rand(n, 1)
    x = simulator(theta, action)
    inference.append_simulations(theta, x, action=action).train()
    model = inference.build_posterior()
    with torch.no_grad():
        error = model.log_ratio(theta, x, action) - log_ratio(theta, x, action)
    if trainer is SeqBED_B:
        # Right but for a function of (x, action): its mean error at likely parameters.
        # Beside any others, which an outcome may exclude, it errs by twice as much.
        scale = (1 + action**2).sqrt()
        likely = action * x / scale**2 + torch.randn(20, n, DIM) / scale
        with torch.no_grad():
            errors = [
                model.log_ratio(t, x, action) - log_ratio(t, x, action) for t in likely
            ]
        error = error - torch.stack(errors).mean(0)
        assert float(error.abs().median()) < 0.25
    else:
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
