"""Discrete parameters beside continuous ones, against the exact posterior."""

import math

import pytest
import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch.distributions import Bernoulli, Categorical, Normal

from sbi_active import Campaign, GaussianNoise, SimulatorModel
from sbi_active.inference import refine
from sbi_active.inference.beliefs.enumerated import EnumeratedBelief

SD = 0.3
ACTION, X = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.2], [1.9]])
#: A gear of three, a slope, a switch.
PRIOR = MultipleIndependent(
    [
        Categorical(torch.tensor([[0.5, 0.3, 0.2]])),
        BoxUniform(torch.tensor([-3.0]), torch.tensor([3.0])),
        Bernoulli(torch.tensor([0.25])),
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
            log_l = Normal(mean, SD).log_prob(X.double()).sum(0)
            prior = math.log((0.5, 0.3, 0.2)[gear] * (0.75, 0.25)[switch])
            log_mass[gear, switch] = log_l.logsumexp(0) + prior
    step = float(slope[1] - slope[0])
    log_evidence = log_mass.flatten().logsumexp(0) + math.log(step / 6)
    return log_mass.flatten().softmax(0), float(log_evidence)


@pytest.mark.parametrize(
    "simulator",
    [SimulatorModel(line, noise=GaussianNoise(SD)), drawn],
    ids=["declared", "drawn"],
)
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
        rows = torch.stack(
            [torch.full_like(slope, gear), slope, torch.full_like(slope, switch)], 1
        )
        total += float(belief.smooth_log_prob(rows).double().exp().sum() * 6 / 3_000)
    assert total == pytest.approx(1, abs=0.02)
    assert belief.log_prob(torch.tensor([0.5, 0.0, 1.0])) == -torch.inf


def test_noise_is_not_inflated_for_a_value_that_trials_rule_out():
    def offset(theta, action):
        return theta[:, :1] * action + 3 * theta[:, 1:]

    switch = Bernoulli(torch.tensor([1e-3]))
    prior = MultipleIndependent(
        [BoxUniform(torch.tensor([-3.0]), torch.tensor([3.0])), switch],
        validate_args=False,
    )
    action = torch.tensor([[1.0], [1.0], [-1.0], [-1.0]])
    x = 0.5 * action + 3 + torch.tensor([[0.1], [-0.1], [0.1], [-0.1]])
    model = SimulatorModel(offset, noise=GaussianNoise(SD))
    belief = refine(model, prior, action, x, seed=0)
    # Off, they miss by ten deviations each: e^-200, whatever the prior.
    assert belief.probability.tolist() == pytest.approx([0.0, 1.0], abs=1e-9)
    assert belief.diagnostics.trustworthy


def test_a_campaign_designs_and_comes_back(tmp_path):
    model = SimulatorModel(line, noise=GaussianNoise(SD))
    campaign = Campaign(
        model,
        PRIOR,
        [0.5, 1.0, 2.0],
        seed=0,
        directory=tmp_path / "campaign",
        options={"num_samples": 100, "num_scored": 100},
    )
    trial = campaign.ask()
    assert 0.5 <= float(trial.action) <= 2.0
    campaign.tell([1.2])
    mean = campaign.update().mean
    assert campaign.history[0].network_used_by == ()
    assert "training" not in campaign.history[0].cpu_seconds
    campaign.close()
    again = Campaign.load(tmp_path / "campaign", simulator=model, prior=PRIOR)
    assert again.belief.mean.tolist() == mean.tolist()
    again.attach([2.0], [1.9])
    assert isinstance(again.update(), EnumeratedBelief)
