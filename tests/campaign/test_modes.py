"""Campaigns under torch's modes without gradients, and priors without width."""

import contextlib
import re

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import Campaign, DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.actions import BoxActions
from tests.campaign.test_corrections import OPTIONS

MODES = (contextlib.nullcontext, torch.no_grad, torch.inference_mode)


def run(mode, method, make_actions):
    """Return actions, scores and draws of a campaign, all of it made in a mode."""
    with mode():
        prior = BoxUniform(torch.zeros(1), torch.ones(1))
        model = SimulatorModel(lambda t, a: t * a, noise=GaussianNoise(0.1))
        c = Campaign(model, prior, make_actions(), method=method, options=OPTIONS)
        for _ in range(2):
            trial = c.ask()
            c.tell(torch.tensor([0.6]) * trial.action, trial=trial)
        c.update()
        c.criticize([], evaluate=False)
    trial = c.ask()  # and goes on outside
    torch.manual_seed(0)
    scores = [(t.surprise, t.log_score, t.information_gained) for t in c.history]
    return trial.action.tolist(), scores, c.belief.sample((20,)).tolist()


@pytest.mark.parametrize("method", ["asbi", "alhi"])
def test_numbers_are_the_same_without_gradients(method):
    def actions():
        return DiscreteActions(torch.tensor([0.5, 1.0, 3.0]))

    plain, *others = (run(mode, method, actions) for mode in MODES)
    assert others == [plain, plain]


@pytest.mark.slow
def test_a_search_by_gradient_finds_the_same_without_gradients():
    def actions():
        return BoxActions(torch.tensor([0.1]), torch.tensor([3.0]))

    plain, *others = (run(mode, "asbi", actions) for mode in MODES)
    assert others == [plain, plain]


def box(low, high, dtype=torch.float32):
    return BoxUniform(*(torch.tensor(bound, dtype=dtype) for bound in (low, high)))


@pytest.mark.parametrize(
    ("prior", "text"),
    [
        (box([0.0, 1.0], [1.0, 1.0]), "got length within [1, 1]"),
        (box([1.0, 0.0], [1.0 + 1e-9, 1.0], torch.float64), "got mass within [1, 1]"),
        (box([0.0, 1.0], [1.0, 1.000001]), "got length within [1, 1.0000"),
        (
            Independent(Normal(torch.full((2,), 5.0), torch.tensor([1.0, 1e-9])), 1),
            "got length within [5, 5]",
        ),
        (box([0.0, 1.0], [1.0, 0.0]), "expected a prior with draws in its support"),
        (box([0.0, float("nan")], [1.0, 1.0]), "expected a prior with draws in its"),
    ],
)
def test_priors_without_width(prior, text):
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] * action,
        noise=GaussianNoise(0.1),
        parameter_names=["mass", "length"],
    )
    with pytest.raises(ValueError, match=re.escape(text)):
        Campaign(model, prior, DiscreteActions([1.0]), options=OPTIONS)


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e20])
def test_narrow_and_wide_priors_that_float32_holds(scale):
    prior = BoxUniform(torch.zeros(1), scale * torch.ones(1))
    model = SimulatorModel(lambda t, a: t / scale * a, noise=GaussianNoise(0.1))
    c = Campaign(
        model, prior, DiscreteActions([1.0, 3.0]), method="nsbi", options=OPTIONS
    )
    c.tell(1.8, action=[3.0])
    assert float(c.update().mean) / scale == pytest.approx(0.6, abs=0.05)
