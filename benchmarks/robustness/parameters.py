"""Attacks on the number of parameters and of numbers in an outcome."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Tensor
from torch.distributions import (
    Beta,
    Distribution,
    Gamma,
    Independent,
    LogNormal,
    MultivariateNormal,
    Normal,
    Uniform,
)

from benchmarks.robustness.exact import Problem
from benchmarks.robustness.run import Attacks
from sbi_active import ASBI, RefinementOptions
from sbi_active.inference import Belief
from sbi_active.seeding import forked_generators
from sbi_active.simulation import Workers

ATTACKS = Attacks()

NUM_DRAWS = 8_000
ACTION = torch.zeros(1)
#: Deviations of the posterior by which a mean may be off: 1/8 nat on one axis.
MEAN = 0.5
#: Factor by which a deviation may be off.
SPREAD = 1.3
Simulator = Callable[[Tensor, Tensor], Any]


def inferred(
    prior: Distribution, simulator: Simulator, x: Tensor, **settings: Any
) -> Belief:
    """Return the belief after one trial, by the path of a user."""
    refinement = RefinementOptions(**settings) if settings else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ASBI(prior, show_progress_bars=False).update(
            x, action=ACTION, simulator=simulator, refinement=refinement, seed=1
        )


def check(belief: Belief, mean: Any, sd: Any) -> None:
    """Raise where the draws' means or deviations are not the posterior's."""
    with forked_generators(0, "check"):
        draws = belief.sample((NUM_DRAWS,)).double()
    mean, sd = torch.as_tensor(mean), torch.as_tensor(sd)
    # The prior's share of 1e-5 is a draw in ten, and may be far away.
    center = (draws.median(0).values - mean) / sd
    kept = ((draws - mean) / sd).clamp(-6, 6)
    shift, factor = kept.mean(0), kept.std(0)
    assert center.abs().max() < 2 * MEAN, f"medians off by {center.abs().max():.2f}"
    assert shift.abs().max() < MEAN, f"means off by {shift.abs().max():.2f} deviations"
    assert factor.max() < SPREAD, f"a deviation is {factor.max():.2f} of the exact"
    assert factor.min() > 1 / SPREAD, f"a deviation is {factor.min():.2f} of the exact"
    assert bool(belief.log_prob(draws.float()).isfinite().all())


def gaussian(
    weight: Tensor, sd: float, mean: Tensor, covariance: Tensor
) -> tuple[Simulator, Tensor, Tensor, Tensor]:
    """Return the simulator of x = A theta + sd e, x, and posterior mean and sd."""
    prior = MultivariateNormal(mean.double(), covariance.double())
    with forked_generators(5):
        theta = prior.sample()
        x = weight @ theta + sd * torch.randn(len(weight)).double()

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        mean = theta.double() @ weight.T
        return mean + sd * torch.randn_like(mean)

    gain = prior.covariance_matrix @ weight.T
    innovation = weight @ gain + sd**2 * torch.eye(len(weight))
    solved = torch.linalg.solve(innovation, gain.T).T
    exact_mean = prior.mean + solved @ (x - weight @ prior.mean)
    exact = prior.covariance_matrix - solved @ gain.T
    return simulator, x, exact_mean, exact.diagonal().sqrt()


def normal_prior(mean: Tensor, covariance: Tensor) -> MultivariateNormal:
    return MultivariateNormal(mean.float(), covariance.float())


def check_gaussian(
    weight: Tensor, sd: float, mean: Tensor | None = None, covariance: Any = None
) -> Belief:
    """Check the belief of x = A theta + sd e, theta standard normal by default."""
    dim = weight.shape[1]
    mean = torch.zeros(dim) if mean is None else mean
    covariance = torch.eye(dim) if covariance is None else covariance
    simulator, x, m, s = gaussian(weight, sd, mean, covariance)
    belief = inferred(normal_prior(mean, covariance), simulator, x.float())
    check(belief, m, s)
    return belief


def matrix(size: int, dim: int, seed: int = 3) -> Tensor:
    with forked_generators(seed):
        return torch.randn(size, dim).double() / dim**0.5


@ATTACKS.add(
    "normal prior, three trials",
    cases=tuple(product((1, 2, 4, 6, 8, 10, 12, 15, 20), (1, 10))),
    seconds=600,
)
def three_trials(case: tuple[int, int]) -> None:
    problem = Problem.draw(*case, seed=50)
    check(problem.infer(50), problem.exact.mean, problem.exact.stddev)


@ATTACKS.add("hundreds of numbers", cases=((1, 1_000), (5, 500), (10, 200)))
def many_numbers(case: tuple[int, int]) -> None:
    dim, size = case
    check_gaussian(matrix(size, dim), 0.5)


#: One axis of a prior, and where its truth lies.
AXES: dict[str, tuple[Distribution, float]] = {
    "normal": (Normal(torch.ones(1), 2.0), 2.0),
    "log-normal": (LogNormal(torch.zeros(1), 0.7), 1.5),
    "beta": (Beta(2 * torch.ones(1), torch.tensor([5.0])), 0.3),
    "gamma": (Gamma(3 * torch.ones(1), 1.5), 1.0),
    "uniform": (Uniform(-torch.ones(1), torch.ones(1)), 0.9),
}


def moments(axis: Distribution, x: float, sd: float) -> tuple[float, float]:
    """Return the mean and sd of a posterior of one parameter, by quadrature."""
    reach = 10 * sd
    grid = torch.linspace(x - reach, x + reach, 20_001).double()
    inside = axis.support.check(grid)  # pyright: ignore
    grid = grid[inside]
    grid = grid[(grid != grid[0]) & (grid != grid[-1])]
    log_weight = axis.log_prob(grid) - 0.5 * ((x - grid) / sd) ** 2
    weight = torch.softmax(log_weight, 0)
    mean = float((weight * grid).sum())
    return mean, float((weight * (grid - mean) ** 2).sum()) ** 0.5


def prior_of(kind: str, dim: int) -> tuple[Distribution, list[str]]:
    """Return a prior of independent axes and their kinds."""
    if kind == "mixed":
        kinds = [[*AXES][j % len(AXES)] for j in range(dim)]
        return MultipleIndependent([AXES[k][0] for k in kinds]), kinds
    axis = AXES[kind][0]
    if kind == "uniform":
        return BoxUniform(-torch.ones(dim), torch.ones(dim)), [kind] * dim
    return Independent(axis.expand(torch.Size([dim])), 1), [kind] * dim


@ATTACKS.add(
    "priors of independent axes",
    cases=(
        *product(("normal", "log-normal", "beta", "gamma", "uniform"), (1, 3, 8, 12)),
        *product(("mixed",), (2, 5, 10, 20)),
        ("uniform", 20),
    ),
    seconds=600,
)
def independent_axes(case: tuple[str, int]) -> None:
    prior, kinds = prior_of(*case)
    sd = 0.25 * prior.sample((2_000,)).std(0)[: len(kinds)].double()
    truth = torch.tensor([AXES[k][1] for k in kinds]).double()
    with forked_generators(7):
        x = truth + sd * torch.randn(len(kinds))

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta.double() + sd * torch.randn(theta.shape)

    exact = [
        moments(AXES[k][0], float(a), float(s))
        for k, a, s in zip(kinds, x, sd, strict=True)
    ]
    check(inferred(prior, simulator, x.float()), *np.transpose(exact))


@ATTACKS.add("a correlated prior", cases=tuple(product((2, 6, 10, 15), (0.5, 0.95))))
def correlated_prior(case: tuple[int, float]) -> None:
    dim, rho = case
    mean = torch.arange(dim).double()
    covariance = (1 - rho) * torch.eye(dim).double() + rho
    check_gaussian(matrix(4, dim), 0.5, mean, covariance)


@ATTACKS.add("only the sum is measured", cases=(2, 4, 8, 12, 20), seconds=300)
def ridge(dim: int) -> None:
    weight = torch.ones(1, dim).double()
    _, x, _, _ = gaussian(weight, 0.05, torch.zeros(dim), torch.eye(dim))
    belief = check_gaussian(weight, 0.05)
    with forked_generators(1):
        total = belief.sample((4_000,)).double().sum(1)
    off = float((total.median() - x[0]).abs()) / 0.05
    assert off < MEAN, f"the sum is off by {off:.2f} deviations"


@ATTACKS.add(
    "parameters and outcomes of extreme scales",
    cases=tuple(product((2, 10), (1e-6, 1e6), (1e-6, 1.0, 1e6))),
)
def scales(case: tuple[int, float, float]) -> None:
    dim, of_theta, of_x = case
    covariance = of_theta**2 * torch.eye(dim).double()
    weight = of_x / of_theta * matrix(2 * dim, dim)
    check_gaussian(weight, 0.3 * of_x, covariance=covariance)


@ATTACKS.add("each parameter of another scale", cases=(3, 7, 10, 14))
def mixed_scales(dim: int) -> None:
    scale = torch.logspace(-5, 5, dim).double()
    weight = matrix(2 * dim, dim) / scale
    check_gaussian(weight, 0.3, 3 * scale, torch.diag(scale**2))


@ATTACKS.add("permuted parameters", cases=(3, 9))
def permuted(dim: int) -> None:
    scale = torch.linspace(0.5, 3, dim).double()
    order = torch.randperm(dim, generator=torch.Generator().manual_seed(0))
    weight = matrix(6, dim)
    for index in (torch.arange(dim), order):
        own = scale[index]
        check_gaussian(weight[:, index], 0.3, own, torch.diag(own**2))


@ATTACKS.add("outcomes of other shapes and types", cases=("(2, 3)", "numpy", "float16"))
def shapes(case: str) -> None:
    dim = 10
    mean, covariance = torch.zeros(dim), torch.eye(dim)
    simulator, x, m, s = gaussian(matrix(6, dim), 0.5, mean, covariance)

    def other(theta: Tensor, action: Tensor) -> Any:
        found = simulator(theta, action)
        if case == "(2, 3)":
            return found.reshape(-1, 2, 3)
        return found.numpy() if case == "numpy" else found.half()

    x_o = x.reshape(2, 3) if case == "(2, 3)" else x
    check(inferred(normal_prior(mean, covariance), other, x_o.float()), m, s)


@ATTACKS.add("half of the numbers not measured", cases=(2, 10))
def partly_measured(dim: int) -> None:
    mean, covariance = torch.zeros(dim), torch.eye(dim)
    weight = matrix(8, dim)
    simulator, x, _, _ = gaussian(weight, 0.5, mean, covariance)
    seen = torch.arange(8) % 2 == 0
    gain = weight[seen].T @ torch.linalg.inv(
        weight[seen] @ weight[seen].T + 0.25 * torch.eye(4)
    )
    exact = torch.eye(dim).double() - gain @ weight[seen]
    belief = inferred(
        normal_prior(mean, covariance),
        simulator,
        torch.where(seen, x, torch.nan).float(),
    )
    check(belief, gain @ x[seen], exact.diagonal().sqrt())


@ATTACKS.add("the same seed twice, and two workers", cases=(3, 10))
def same_seed(dim: int) -> None:
    mean, covariance = torch.zeros(dim), torch.eye(dim)
    simulator, x, _, _ = gaussian(matrix(4, dim), 0.5, mean, covariance)
    prior = normal_prior(mean, covariance)
    first, *others = (
        inferred(prior, simulator, x.float(), num_histories=400, workers=Workers(num))
        for num in (1, 1, 2)
    )
    with forked_generators(0):
        theta = prior.sample((200,))
    for other in others:
        assert torch.equal(first.log_prob(theta), other.log_prob(theta))


@ATTACKS.add(
    "too few simulations are said to be too few",
    cases=tuple(product((2, 8, 12, 20), (2, 200))),
    seconds=300,
)
def few_simulations(case: tuple[int, int]) -> None:
    problem = Problem.draw(*case, seed=60)
    belief = inferred(
        problem.prior, problem.simulator, problem.x[1].float(), num_histories=200
    )
    one = Problem(
        problem.simulator, problem.prior, problem.action, problem.x, _one(problem)
    )
    divergence = one.divergence(belief)["kl"]
    trusted = belief.diagnostics.trustworthy
    assert not (divergence > 0.5 and trusted), f"trusted, though {divergence:.2f} off"
    assert trusted or divergence > 0.1, f"not trusted, though {divergence:.2f} off"


def _one(problem: Problem) -> MultivariateNormal:
    """Return the exact posterior of the second trial alone, at the action zero."""
    dim = problem.exact.mean.shape[0]
    unit = torch.eye(dim)
    with forked_generators(0):  # the mean at unit parameters, less much of the noise
        many = unit.repeat_interleave(20_000, 0)
        zero = torch.zeros(len(many), 1)
        design = problem.simulator(many, zero).reshape(dim, 20_000, -1).mean(1).T
    precision = torch.eye(dim).double() + design.T @ design / 0.25
    mean = torch.linalg.solve(precision, design.T @ problem.x[1] / 0.25)
    return MultivariateNormal(mean, precision_matrix=precision)
