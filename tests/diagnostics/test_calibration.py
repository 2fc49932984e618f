import json
from types import SimpleNamespace

import matplotlib
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import MultivariateNormal

from sbi_active import ASBI, BoxActions, DiscreteActions, MixtureDensity, SimulatorModel
from sbi_active.diagnostics import check_belief, check_calibration
from sbi_active.inference import ActionPosterior
from sbi_active.seeding import forked_generators

matplotlib.use("Agg")
PRIOR = BoxUniform(-torch.ones(1), torch.ones(1))
ACTIONS = DiscreteActions([0.5, 1.0, 2.0], names=["gain"])
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=0.2)


class Exact:
    """The exact posterior without the edges, changed at one action."""

    def __init__(self, factor=1.0, at=1.0):
        self.factor, self.at = factor, at

    def parts(self, condition):
        x, action = condition[:, :1], condition[:, 1:]
        wrong = (action - self.at).abs() < 1e-4
        sd = 0.2 / action * torch.where(wrong, self.factor, 1.0)
        return torch.distributions.Normal(x / action, sd)

    def log_prob(self, theta, condition):
        return self.parts(condition).log_prob(theta).sum(-1)

    def sample(self, shape, condition):
        return self.parts(condition).sample(shape)


@pytest.fixture(scope="module")
def trained():
    settings = MixtureDensity(hidden_features=(16,), num_iterations=10)
    with forked_generators(0):
        inference = ASBI(PRIOR, density_estimator=settings)
        theta, action = PRIOR.sample((500,)), ACTIONS.sample((500,))
        inference.append_simulations(theta, MODEL(theta, action), action=action)
        inference.train()
    return inference


def with_network(trained, network):
    posterior = trained.build_posterior()
    packed = posterior.packed()

    class Module(torch.nn.Module):
        input_shape, condition_shape = torch.Size([1]), torch.Size([2])
        log_prob = staticmethod(network.log_prob)
        sample = staticmethod(network.sample)

    packed.posterior_estimator = Module()
    return ActionPosterior(packed, posterior.x_shape, posterior.action_dim)


def check(posterior, **options):
    given = {"actions": ACTIONS, "num_simulations": 600, **options}
    return check_calibration(posterior, MODEL, **given)


def test_a_right_network_is_trusted_and_a_wrong_one_flagged(trained):
    right = check(with_network(trained, Exact()))
    assert right.verdict == "trust"
    assert not right.flagged
    assert abs(right.overall.gap) < 0.1
    narrow = check(with_network(trained, Exact(0.4)))
    assert narrow.flagged == ["gain 1"]
    assert narrow.verdict == "stop"


def test_a_blunt_network_passes_ranks_and_not_the_gap(trained):
    class Blunt(Exact):
        def parts(self, condition):
            low = -torch.ones(len(condition), 1)
            return torch.distributions.Uniform(low, -low, validate_args=False)

    for gap in ("likelihood", "classifier"):
        found = check(with_network(trained, Blunt()), gap=gap)
        assert found.verdict == "refine"
        assert "blunt" in found.reasons[0]
        low, high = found.overall.coverage_interval
        assert low < 0.9 < high


@pytest.mark.parametrize("gap", ["likelihood", "classifier"])
def test_a_result_says_itself_and_leaves_the_generators_alone(trained, gap):
    before = torch.random.get_rng_state()
    found, again = (check(trained, num_simulations=150, gap=gap) for _ in "ab")
    assert found.gap_method == gap
    assert (torch.random.get_rng_state() == before).all()
    assert (found.ranks == again.ranks).all()
    assert again.to_dict() == found.to_dict()
    assert json.loads(json.dumps(found.to_dict()))["verdict"] == found.verdict
    assert str(found).startswith(found.verdict)
    assert len(found.plot().axes) == 1
    assert found.verdict != "trust" or found.overall.lost < 0.4


def gaussian(action, x, factor=1.0):
    precision = 1e-4 + (action**2).sum() / 0.04
    mean = (action * x).sum() / 0.04 / precision
    return MultivariateNormal(mean.reshape(1), factor**2 / precision.reshape(1, 1))


#: Factors of the belief and of all beliefs, and verdicts.
WIDTHS = [
    (1.0, 1.0, ("trust",)),
    (2.0, 1.0, ("refine",)),
    (0.5, 1.0, ("stop", "refine")),
    (2.0, 2.0, ("refine",)),
    (0.5, 0.5, ("stop",)),
]


@pytest.mark.parametrize(("own", "every", "verdicts"), WIDTHS)
def test_a_belief_too_wide_or_narrow_is_flagged(own, every, verdicts):
    action = torch.tensor([[1.0], [2.0]])
    x = torch.tensor([[0.4], [0.9]])
    prior = MultivariateNormal(torch.zeros(1), 1e4 * torch.eye(1))
    trials = [SimpleNamespace(action=a, x=v) for a, v in zip(action, x, strict=True)]
    belief = gaussian(action, x, own)
    inference = SimpleNamespace(trials=trials, belief=belief, _prior=prior)
    again = {"infer": lambda a, x, _: gaussian(a, x, every), "num_repeats": 60}
    found = check_belief(inference, MODEL, **again)
    assert found.verdict in verdicts, found


def test_a_continuum_of_actions_and_invalid_rows(trained):
    space = BoxActions([0.5], [2.0], names=["gain"])

    def fails(theta, action):
        x = theta * action
        return torch.where(action > 1.8, torch.nan, x)

    model = SimulatorModel(fails, noise=0.2)
    posterior = with_network(trained, Exact())
    sizes = {"num_simulations": 400, "max_strata": 3}
    found = check_calibration(posterior, model, actions=space, **sizes)
    assert len(found.strata) == 3
    assert found.strata[-1].name.startswith("near gain")
    assert found.num_invalid > 10
    assert len(found.ranks) + found.num_invalid == 400
    assert found.verdict == "trust"
