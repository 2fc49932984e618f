"""The campaign that is attacked, and what must hold of it.

The problem is x = theta * action with a noise of .1 and theta uniform on [0, 1], the
truth .6; so that every belief is known: after trials at the actions a, its mean is
near .6 and its deviation near .1 / |a|.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails
from sbi_active.criticism import Effect
from sbi_active.inference import RatioClassifier

TRUTH = 0.6
TOLD = ((1.0, 0.62), (3.0, 1.75), (0.5, 0.33))  # action, x
METHODS = ("asbi", "nsbi", "alhi", "nlhi", "seqbed")
PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([0.5, 1.0, 3.0])
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=GaussianNoise(0.1))
OPTIONS = CampaignOptions(
    num_simulations=300,
    num_samples=100,
    details=CampaignDetails(num_scored=200),
    density_estimator=MixtureDensity(hidden_features=(16,), num_iterations=30),
    refinement=RefinementOptions(num_histories=300, num_effective=25),
)
BIAS = Effect(
    "bias",
    hook="observation",
    prior=Independent(Normal(torch.zeros(1), torch.ones(1)), 1),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi,
)


def noisy(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Return draws by torch's global generator."""
    return theta * action + 0.1 * torch.randn_like(theta)


def campaign(
    method: str = "nsbi",
    simulator: Callable[..., Any] = MODEL,
    prior: Any = PRIOR,
    actions: Any = ACTIONS,
    effects: Any = (),
    seed: int = 0,
    directory: str | None = None,
    **changes: Any,
) -> Campaign:
    """Return a small campaign."""
    options = OPTIONS
    if method == "seqbed":
        network = RatioClassifier(hidden_features=(16,), num_iterations=50)
        options = replace(options, density_estimator=network)
    return Campaign(
        simulator,
        prior,
        actions,
        method=method,
        effects=effects,
        seed=seed,
        directory=directory,
        options=replace(options, **changes),
    )


def tell(c: Campaign, bad: dict[int, float] | None = None) -> Campaign:
    """Tell three trials, some of them wrong."""
    for i, (action, x) in enumerate(TOLD):
        c.tell((bad or {}).get(i, x), action=[action])
    return c


@contextlib.contextmanager
def refused(*words: str) -> Iterator[None]:
    """Expect a ValueError that has these words."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        assert all(word in text for word in words), text
    else:
        raise AssertionError("nothing was refused")


def draws(c: Campaign) -> torch.Tensor:
    """Return draws of a belief that depend on it alone."""
    torch.manual_seed(7)
    return c.belief.sample(torch.Size([300]))


def right(c: Campaign, width: float = 0.15) -> None:
    """Require a belief around the truth, with a measurement's width."""
    theta = draws(c)
    assert bool(theta.isfinite().all())
    assert abs(float(theta.median()) - TRUTH) < width, float(theta.median())
    assert float((theta - theta.median()).abs().median()) < width


def doubted(c: Campaign, index: int) -> None:
    """Require a belief that says which trial is to be mended."""
    diagnostics = c.belief.diagnostics  # pyright: ignore
    assert diagnostics.trustworthy is False
    text = " ".join(diagnostics.warnings)
    assert f"trial {index} at" in text, text
    assert f"withdraw({index})" in text, text


def same(first: Campaign, second: Campaign) -> None:
    """Require the same beliefs, scores and health, bit by bit."""
    first.update()
    second.update()
    assert torch.equal(draws(first), draws(second))
    for a, b in zip(first.history, second.history, strict=True):
        for name in ("surprise", "log_score", "misfit", "information_gained"):
            assert getattr(a, name) == getattr(b, name), name
    assert first.health == second.health
