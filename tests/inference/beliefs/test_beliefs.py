"""Beliefs: the priors they begin from, discrete values, and what is known of them."""

import json
import math

import pytest
import scipy.stats
import torch
from sbi.utils import BoxUniform, MultipleIndependent
from sbi.utils.torchutils import set_validate_args
from torch import distributions as dist
from torch.distributions.transforms import AffineTransform, ExpTransform

from sbi_active import BoxActions, Campaign, GaussianNoise, SimulatorModel
from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.beliefs.enumerated import EnumeratedBelief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.seeding import draws_of, forked_generators

KNOWN = Diagnostics(
    trustworthy=True,
    assumptions={"settled": Assumption(False, 0.3)},
    num_simulations=300,
    tail_probability=0.4,
    tail_probability_of_trial=(0.4, 0.6),
    error_nats=0.02,
).extended(bandwidth=0.1, num_missing=2)


def test_as_plain_data():
    plain = KNOWN.to_dict()
    assert json.loads(json.dumps(plain)) == plain
    assert plain["assumptions"] == {"settled": {"holds": False, "figure": 0.3}}
    assert plain["bandwidth"] == 0.1
    assert "effective_sample_size" not in plain  # not known


# Discrete parameters beside continuous ones, against the exact posterior


SD = 0.3
ACTION, X = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.2], [1.9]])
#: A gear of three, a slope, a switch.
PRIOR = MultipleIndependent(
    [
        dist.Categorical(torch.tensor([[0.5, 0.3, 0.2]])),
        BoxUniform(torch.tensor([-3.0]), torch.tensor([3.0])),
        dist.Bernoulli(torch.tensor([0.25])),
    ],
    validate_args=False,
)


def line(theta, action):
    return theta[:, 1:2] * action * (1 + theta[:, :1]) + theta[:, 2:]


def drawn(theta, action):
    return line(theta, action) + SD * torch.randn(len(theta), 1)


def exact():
    """Return probabilities of gear and switch, by a sum over a fine grid."""
    slope = torch.linspace(-3, 3, 20_001).double()
    log_mass = torch.zeros(3, 2).double()
    for gear in range(3):
        for switch in range(2):
            mean = slope * ACTION.double() * (1 + gear) + switch
            log_l = dist.Normal(mean, SD).log_prob(X.double()).sum(0)
            prior = math.log((0.5, 0.3, 0.2)[gear] * (0.75, 0.25)[switch])
            log_mass[gear, switch] = log_l.logsumexp(0) + prior
    step = float(slope[1] - slope[0])
    log_evidence = log_mass.flatten().logsumexp(0) + math.log(step / 6)
    return log_mass.flatten().softmax(0), float(log_evidence)


@pytest.mark.parametrize("simulator", [SimulatorModel(line, noise=SD), drawn])
def test_values_get_their_probabilities(simulator):
    belief = refine(simulator, PRIOR, ACTION, X, seed=0)
    assert isinstance(belief, EnumeratedBelief)
    probability, log_evidence = exact()
    assert belief.values.tolist() == [[g, s] for g in range(3) for s in range(2)]
    assert belief.probability.numpy() == pytest.approx(probability.numpy(), abs=0.04)
    assert belief.diagnostics.log_evidence == pytest.approx(log_evidence, abs=0.15)
    assert belief.diagnostics.trustworthy
    torch.manual_seed(0)
    theta = belief.sample((6_000,))
    assert theta[:, [0, 2]].frac().abs().max() == 0
    share = (2 * theta[:, 0] + theta[:, 2]).long().bincount(minlength=6) / 6_000
    assert share.double().numpy() == pytest.approx(probability.numpy(), abs=0.05)
    # A density over the slope at each pair of values, which all integrate to one.
    slope = torch.linspace(-3, 3, 3_001)
    total = 0.0
    for gear, switch in belief.values.tolist():
        rows = torch.tensor([gear, 0.0, switch]).repeat(len(slope), 1)
        rows[:, 1] = slope
        total += float(belief.smooth_log_prob(rows).double().exp().sum() * 6 / 3_000)
    assert total == pytest.approx(1, abs=0.02)
    assert belief.log_prob(torch.tensor([0.5, 0.0, 1.0])) == -torch.inf


def test_noise_is_not_inflated_for_a_value_that_trials_rule_out():
    def offset(theta, action):
        return theta[:, :1] * action + 3 * theta[:, 1:]

    switch = dist.Bernoulli(torch.tensor([1e-3]))
    parts = [BoxUniform(torch.tensor([-3.0]), torch.tensor([3.0])), switch]
    prior = MultipleIndependent(parts, validate_args=False)
    action = torch.tensor([[1.0], [1.0], [-1.0], [-1.0]])
    x = 0.5 * action + 3 + torch.tensor([[0.1], [-0.1], [0.1], [-0.1]])
    model = SimulatorModel(offset, noise=SD)
    belief = refine(model, prior, action, x, seed=0)
    # Off, they miss by ten deviations each: e^-200, whatever the prior.
    assert belief.probability.tolist() == pytest.approx([0.0, 1.0], abs=1e-9)
    assert belief.diagnostics.trustworthy


def test_a_campaign_designs_and_comes_back(tmp_path):
    model = SimulatorModel(line, noise=SD)
    sizes = {"num_samples": 100, "num_scored": 100}
    given = {"directory": tmp_path / "campaign", "options": sizes}
    campaign = Campaign(model, PRIOR, [0.5, 1.0, 2.0], **given)
    trial = campaign.ask()
    assert 0.5 <= float(trial.action) <= 2.0
    campaign.tell([1.2])
    mean = campaign.update().mean
    assert "training" not in campaign.history[0].cpu_seconds
    campaign.close()
    again = Campaign.load(tmp_path / "campaign", simulator=model, prior=PRIOR)
    assert again.belief.mean.tolist() == mean.tolist()
    again.attach([2.0], [1.9])
    assert isinstance(again.update(), EnumeratedBelief)


# Which priors a belief can begin from, and that those give the right posterior


TWO = torch.ones(2)
SHIFTED_EXPONENTIAL = [ExpTransform(), AffineTransform(0.2, 1.0)]


def independent(prior: dist.Distribution) -> dist.Independent:
    return dist.Independent(prior, 1)


#: Priors that none can begin from, and what is said of them.
NO_PRIORS = [
    (independent(dist.Poisson(3 * TWO)), "continuous parameters; got a discrete one"),
    (independent(dist.Bernoulli(0.5 * TWO)), "declare the choice as an Effect"),
    (dist.Dirichlet(TWO), "may vary one by one; got Dirichlet"),
    (scipy.stats.uniform(), "with a support, .*; got rv_continuous_frozen"),
    (dist.Normal(0.0, 1.0), r"event shape \(theta_dim,\); got Normal"),
]


@pytest.mark.parametrize(("prior", "message"), NO_PRIORS)
def test_what_is_discrete_or_tied_is_refused(prior, message):
    with pytest.raises(ValueError, match=message):
        require_support(prior)
    with pytest.raises(ValueError, match=message):
        campaign(prior)


@pytest.mark.parametrize("names", [["mass"], ["mass", "mass"]])
def test_each_parameter_has_a_name_of_its_own(names):
    model = SimulatorModel(
        lambda theta, action: theta * action,
        noise=GaussianNoise(0.1),
        parameter_names=names,
    )
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    with pytest.raises(ValueError, match="a different name for each of 2 parameters"):
        Campaign(model, prior, BoxActions([0.0], [1.0]))


def test_draws_that_repeat_are_refused():
    class Rounded(dist.Normal):
        def sample(self, sample_shape=torch.Size()):  # noqa: B008
            return super().sample(sample_shape).round()

    with pytest.raises(ValueError, match="got parameter 0, of which draws repeat"):
        campaign(independent(Rounded(0 * TWO, TWO)))


def scaled(theta, action):
    return theta * action


def campaign(prior: dist.Distribution, network: str = "on demand") -> Campaign:
    model = SimulatorModel(scaled, noise=0.2)
    options = {"num_simulations": 300, "num_samples": 100, "num_scored": 100}
    options |= {"network": network}
    return Campaign(model, prior, BoxActions([0.5], [2.0]), options=options)


@pytest.mark.parametrize(
    "prior",
    [
        independent(dist.Cauchy(0 * TWO, TWO)),
        dist.TransformedDistribution(
            independent(dist.Normal(0 * TWO, TWO)), SHIFTED_EXPONENTIAL
        ),
        dist.MixtureSameFamily(
            dist.Categorical(TWO),
            independent(dist.Uniform(torch.tensor([[0.0], [0.2]]).expand(2, 2), 1.0)),
        ),
        independent(dist.VonMises(0 * TWO, TWO)),
    ],
    ids=["Cauchy", "shifted log-normal", "mixture of bounds", "angle"],
)
def test_heavy_tails_and_mixtures_give_the_right_posterior(prior):
    set_validate_args(prior, True)  # as after an import of pyro, which says so for all
    x, is_mixed = torch.tensor([0.6, 0.5]), isinstance(prior, dist.MixtureSameFamily)
    c = campaign(prior, "each round" if is_mixed else "on demand")
    if is_mixed:
        c.ask()  # the network is trained and asked as well
    c.tell(x, action=[1.0])
    belief = c.update()
    drawn = belief.sample((4_000,)).double()
    with forked_generators(0):
        theta = prior.sample((200_000,)).double()
    square = (((theta - x) / 0.2) ** 2).sum(1)
    weight = torch.softmax(-0.5 * square, 0)[:, None]
    mean = (weight * theta).sum(0)
    sd = (weight * (theta - mean) ** 2).sum(0).sqrt()
    # The reference has some 5,000 effective draws, the belief's own error is below .1.
    assert bool(((drawn.mean(0) - mean).abs() < 0.2 * sd).all())
    assert bool((drawn.std(0) / sd - 1).abs().max() < 0.2)
    assert bool(belief.log_prob(theta[:100].float()).isfinite().all())


@pytest.mark.parametrize("noise", [GaussianNoise(1e-3), None])
def test_moments_are_those_of_the_posterior_beside_a_wide_prior(noise):
    """One draw of the prior's share made a deviation twenty times too large."""

    def line(theta, action):
        error = 0.0 if noise else 1e-3 * torch.randn(len(theta), 1)
        return theta * action + error

    wide = RefinementOptions(defensive=0.01)
    action, x = torch.tensor([[1.0], [2.0]]), torch.tensor([[0.4005], [0.8]])
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    simulator = SimulatorModel(line, noise=noise)
    belief = refine(simulator, prior, action, x, settings=wide, seed=0)
    exact = 1e-3 * 5**-0.5
    assert belief.variance.sqrt().item() == pytest.approx(exact, rel=0.1)
    assert belief.mean.item() == pytest.approx(0.4001, abs=0.2 * exact)
    drawn = draws_of(belief, 2_000, 0, "any").std().item()
    assert drawn == pytest.approx(exact, rel=0.1)
    # What is drawn as from any distribution has the density of the distribution.
    with forked_generators(0):
        spread = belief.sample((20_000,)).std().item()
    assert spread == pytest.approx((0.01 * (1 / 12 + 0.01)) ** 0.5, rel=0.15)


@pytest.mark.parametrize("noise", [GaussianNoise(1e-2), None])
@pytest.mark.parametrize(("truth", "is_at_end"), [(0.5, False), (0.0, True)])
def test_a_bound_is_far_in_deviations_of_the_belief(noise, truth, is_at_end):
    """All that lay in the last hundredth of a wide prior was doubted."""

    def line(theta, action):
        error = 0.0 if noise else 1e-2 * torch.randn(len(theta), 1)
        return theta * action + error

    simulator = SimulatorModel(line, noise=noise)
    prior = BoxUniform(torch.zeros(1), torch.full((1,), 100.0))
    action, off = torch.tensor([[1.0], [2.0]]), torch.tensor([[5e-3], [-5e-3]])
    belief = refine(simulator, prior, action, truth * action + off, seed=0)
    assert any("edge" in text for text in belief.diagnostics.warnings) == is_at_end


def test_a_belief_is_the_prior_of_the_next_campaign():
    def slide(theta, action):
        return action**2 / (2 * 9.81 * theta)

    model = SimulatorModel(slide, noise=0.02)
    prior = BoxUniform(torch.tensor([0.2]), torch.tensor([1.0]))
    rest = {"seed": 0, "options": {"network": "on demand"}}
    belief, both = prior, Campaign(model, prior, BoxActions([0.5], [3.0]), **rest)
    for x in (0.60, 0.62):
        c = Campaign(model, belief, BoxActions([0.5], [3.0]), **rest)
        c.attach([3.0], [x])
        both.attach([3.0], [x])
        belief = c.update()
    together = both.update()
    assert float(belief.mean) == pytest.approx(float(together.mean), abs=0.004)
    assert float(belief.stddev) == pytest.approx(float(together.stddev), rel=0.15)
