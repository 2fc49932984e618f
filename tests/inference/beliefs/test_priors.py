"""Which priors a belief can begin from, and that those give the right posterior."""

import pytest
import torch
from sbi.utils import BoxUniform
from sbi.utils.torchutils import set_validate_args
from torch.distributions import (
    Bernoulli,
    Categorical,
    Cauchy,
    Dirichlet,
    Distribution,
    Independent,
    MixtureSameFamily,
    Normal,
    Poisson,
    TransformedDistribution,
    Uniform,
    VonMises,
)
from torch.distributions.transforms import AffineTransform, ExpTransform

from sbi_active import BoxActions, Campaign, GaussianNoise, SimulatorModel
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.seeding import forked_generators

TWO = torch.ones(2)


def independent(prior: Distribution) -> Independent:
    return Independent(prior, 1)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (independent(Poisson(3 * TWO)), "continuous parameters; got a discrete one"),
        (independent(Bernoulli(0.5 * TWO)), "declare the choice as an Effect"),
        (Dirichlet(TWO), "may vary one by one; got Dirichlet"),
        (Normal(0.0, 1.0), r"event shape \(theta_dim,\); got Normal"),
    ],
)
def test_what_is_discrete_or_tied_is_refused(prior, message):
    with pytest.raises(ValueError, match=message):
        require_support(prior)
    with pytest.raises(ValueError, match=message):
        campaign(prior)


def test_draws_that_repeat_are_refused():
    class Rounded(Normal):
        def sample(self, sample_shape=torch.Size()):  # noqa: B008
            return super().sample(sample_shape).round()

    with pytest.raises(ValueError, match="got parameter 0, of which draws repeat"):
        campaign(independent(Rounded(0 * TWO, TWO)))


def scaled(theta, action):
    return theta * action


def campaign(prior: Distribution, method: str = "asbi", **options) -> Campaign:
    return Campaign(
        SimulatorModel(scaled, noise=GaussianNoise(0.2)),
        prior,
        BoxActions([0.5], [2.0]),
        method=method,
        seed=0,
        options={
            "num_simulations": 300,
            "num_samples": 100,
            "num_scored": 100,
            **options,
        },
    )


NETWORKS = {True: "each round", False: "on demand"}


@pytest.mark.parametrize(
    "prior",
    [
        independent(Cauchy(0 * TWO, TWO)),
        TransformedDistribution(
            independent(Normal(0 * TWO, TWO)),
            [ExpTransform(), AffineTransform(0.2, 1.0)],
        ),
        MixtureSameFamily(
            Categorical(TWO),
            independent(Uniform(torch.tensor([[0.0], [0.2]]).expand(2, 2), 1.0)),
        ),
        independent(VonMises(0 * TWO, TWO)),
    ],
    ids=["Cauchy", "shifted log-normal", "mixture of bounds", "angle"],
)
def test_heavy_tails_and_mixtures_give_the_right_posterior(prior):
    set_validate_args(prior, True)  # as after an import of pyro, which says so for all
    is_mixed = isinstance(prior, MixtureSameFamily)
    c, x = campaign(prior, network=NETWORKS[is_mixed]), torch.tensor([0.6, 0.5])
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


def test_a_belief_is_the_prior_of_the_next_campaign():
    def slide(theta, action):
        return action**2 / (2 * 9.81 * theta)

    model = SimulatorModel(slide, noise=GaussianNoise(0.02))
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
