"""Attacks by priors: heavy tails, mixtures, bounds, discrete or tied parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Tensor
from torch import distributions as dist
from torch.distributions import Independent, MixtureSameFamily
from torch.distributions.transforms import (
    AffineTransform,
    ExpTransform,
    SigmoidTransform,
)

from benchmarks.robustness.campaign_problem import OPTIONS
from benchmarks.robustness.run import Attacks
from sbi_active import (
    BoxActions,
    Campaign,
    GaussianNoise,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.seeding import forked_generators

ATTACKS = Attacks()
ONE, TWO = torch.ones(1), torch.ones(2)
X = torch.tensor([0.6, 0.5])
SD = 0.2


def each(prior: Any) -> Independent:
    """Return independent numbers of a distribution of shape (2,)."""
    return Independent(prior, 1)


def mixture() -> Any:
    """Return two modes in two dimensions."""
    centers = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    return MixtureSameFamily(
        dist.Categorical(TWO), each(dist.Normal(centers, 0.5 * torch.ones(2, 2)))
    )


RIGHT: dict[str, Callable[[], Any]] = {
    "uniform": lambda: BoxUniform(0 * TWO, TWO),
    "uniform float64": lambda: BoxUniform(0 * TWO.double(), TWO.double()),
    "normal": lambda: each(dist.Normal(0 * TWO, TWO)),
    "full covariance": lambda: dist.MultivariateNormal(
        0 * TWO, torch.tensor([[1.0, 0.9], [0.9, 1.0]])
    ),
    "low rank": lambda: dist.LowRankMultivariateNormal(
        0 * TWO, torch.ones(2, 1), 0.5 * TWO
    ),
    "Laplace": lambda: each(dist.Laplace(0 * TWO, TWO)),
    "Gumbel": lambda: each(dist.Gumbel(0 * TWO, TWO)),
    "Gamma": lambda: each(dist.Gamma(2 * TWO, 2 * TWO)),
    "Beta": lambda: each(dist.Beta(2 * TWO, 2 * TWO)),
    "Beta of infinite density": lambda: each(dist.Beta(0.5 * TWO, 0.5 * TWO)),
    "Exponential": lambda: each(dist.Exponential(TWO)),
    "Weibull": lambda: each(dist.Weibull(TWO, 1.5 * TWO)),
    "half normal": lambda: each(dist.HalfNormal(TWO)),
    "half Cauchy": lambda: each(dist.HalfCauchy(TWO)),
    "log normal": lambda: each(dist.LogNormal(0 * TWO, TWO)),
    "Cauchy": lambda: each(dist.Cauchy(0 * TWO, TWO)),
    "Student 1": lambda: each(dist.StudentT(TWO)),
    "Student 3": lambda: each(dist.StudentT(3 * TWO)),
    "Pareto": lambda: each(dist.Pareto(0.1 * TWO, TWO)),
    "mixture": mixture,
    "mixture of bounds": lambda: MixtureSameFamily(
        dist.Categorical(TWO),
        each(dist.Uniform(torch.tensor([[0.0], [0.2]]).expand(2, 2), 1.0)),
    ),
    "mixture with validation": lambda: MixtureSameFamily(
        dist.Categorical(TWO, validate_args=True),
        each(dist.Uniform(torch.tensor([[0.0], [0.2]]).expand(2, 2), 1.0)),
        validate_args=True,
    ),
    "shifted log normal": lambda: dist.TransformedDistribution(
        each(dist.Normal(0 * TWO, TWO)), [ExpTransform(), AffineTransform(0.2, 1.0)]
    ),
    "logit normal": lambda: dist.TransformedDistribution(
        each(dist.Normal(0 * TWO, TWO)), [SigmoidTransform()]
    ),
    "different ones": lambda: MultipleIndependent(
        [dist.Gamma(2 * ONE, 2 * ONE), dist.Normal(0 * ONE, ONE)], validate_args=False
    ),
    "angle": lambda: each(dist.VonMises(0 * TWO, TWO)),
}
REFUSED: dict[str, Callable[[], Any]] = {
    "Poisson": lambda: each(dist.Poisson(3 * TWO)),
    "Bernoulli": lambda: each(dist.Bernoulli(0.5 * TWO)),
    "Categorical": lambda: each(dist.Categorical(torch.ones(2, 3))),
    "one hot": lambda: dist.OneHotCategorical(TWO),
    "payload": lambda: MultipleIndependent(
        [BoxUniform(0 * ONE, ONE), dist.Bernoulli(0.5 * ONE)], validate_args=False
    ),
    "Dirichlet": lambda: dist.Dirichlet(TWO),
    "correlations": lambda: dist.LKJCholesky(2, 1.0),
    "no width": lambda: BoxUniform(TWO, TWO),
    "NaN": lambda: BoxUniform(0 * TWO, torch.nan * TWO),
    "number": lambda: dist.Normal(0.0, 1.0),
    "batch of numbers": lambda: dist.Normal(0 * TWO, TWO),
    "None": lambda: None,
    "a list": lambda: [0.0, 1.0],
    "Wishart": lambda: dist.Wishart(torch.tensor([4.0])[0], torch.eye(2)),
}


def begun(prior: Any, method: str = "asbi") -> Campaign:
    """Return a campaign with x = theta * action."""
    model = SimulatorModel(
        lambda theta, action: theta * action, noise=GaussianNoise(SD)
    )
    # The moments are asked for at .25 deviations: 300 histories are off by .2.
    refinement = RefinementOptions(num_histories=2_000, num_effective=50)
    return Campaign(
        model,
        prior,
        BoxActions([0.5], [2.0]),
        method=method,
        options=replace(OPTIONS, refinement=refinement),
    )


def require_posterior(belief: Any, prior: Any) -> None:
    """Require the moments of an importance sample of 200,000 draws."""
    drawn = belief.sample((4_000,)).double()
    with forked_generators(0):
        theta = prior.sample((200_000,)).double()
    square = (((theta - X) / SD) ** 2).sum(1)
    weight: Tensor = torch.softmax(-0.5 * square, 0)[:, None]
    mean = (weight * theta).sum(0)
    sd = (weight * (theta - mean) ** 2).sum(0).sqrt()
    assert bool(((drawn.mean(0) - mean).abs() < 0.25 * sd).all()), (drawn.mean(0), mean)
    assert bool(((drawn.std(0) / sd - 1).abs() < 0.25).all()), (drawn.std(0), sd)


@ATTACKS.add(
    "a belief that begins from it",
    cases=[(name, method) for name in RIGHT for method in ("asbi", "nsbi")],
)
def right(case: tuple[str, str]) -> None:
    name, method = case
    prior = RIGHT[name]()
    c = begun(prior, method)
    c.ask()
    c.tell(X, action=[1.0])
    require_posterior(c.update(), RIGHT[name]())


@ATTACKS.add("one that a belief cannot begin from", cases=list(REFUSED))
def refused(name: str) -> None:
    try:
        prior = REFUSED[name]()
    except ValueError:  # torch says so itself
        return
    try:
        begun(prior)
    except (ValueError, TypeError) as error:
        assert str(error).startswith("expected"), error
    else:
        raise AssertionError("accepted")


@ATTACKS.add("a belief as the next prior", cases=("asbi", "nsbi"))
def again(method: str) -> None:
    first = begun(BoxUniform(0 * TWO, TWO), method)
    first.tell(X, action=[1.0])
    second = begun(first.update(), method)
    second.ask()
    second.tell(X, action=[1.0])
    drawn = second.update().sample((4_000,)).double()
    assert bool(((drawn.mean(0) - X).abs() < 0.05).all()), drawn.mean(0)
    assert bool((drawn.std(0) / (SD / 2**0.5) - 1).abs().max() < 0.25), drawn.std(0)
