"""Leave-one-out densities against the closed form of a linear model."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Independent, MultivariateNormal, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.steps.leave_one_out import (
    NUM_DRAWS,
    LeaveOneOut,
    leave_one_out,
)

PRIOR = Independent(Normal(torch.zeros(2), torch.tensor([2.0, 1.0])), 1)
NOISE = 0.5
ACTION = torch.linspace(-2, 2, 10)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 1.2, 1.1, 1.5, 1.9, 0.9, 2.0])[:, None]
BIAS = Effect(
    "square",
    hook="observation",
    prior=Independent(Normal(torch.zeros(1), torch.ones(1)), 1),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi * action**2,
)


def criticism(x: torch.Tensor) -> Criticism:
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] + theta[:, 1:] * action,
        noise=GaussianNoise(NOISE),
    )
    return Criticism(model, PRIOR, Trials(ACTION, x), effects=[BIAS])


def exact(x: torch.Tensor, *, curved: bool) -> np.ndarray:
    """Return log p(x_t | x_-t) of the line, or of the parabola, shape (t,)."""
    xi = ACTION[:, 0].double()
    design = torch.stack([2 * xi**0, xi, *([xi**2] if curved else [])], 1)
    cov = design @ design.T + NOISE**2 * torch.eye(len(xi))

    def log_p(keep: torch.Tensor) -> float:
        part = cov[keep][:, keep]
        normal = MultivariateNormal(torch.zeros(len(part)).double(), part)
        return float(normal.log_prob(x[keep, 0].double()))

    every = torch.arange(len(xi))
    return np.array([log_p(every) - log_p(every[every != t]) for t in every])


def test_densities_are_those_of_refits():
    x = X + 0.4 * ACTION**2
    loop = criticism(x)
    tracing = loop.trace()
    assert tracing.verdict == "square"
    found = leave_one_out(loop.rivals, tracing)
    assert [one.name for one in found] == ["none", "square"]
    for one, curved in zip(found, (False, True), strict=True):
        expected = exact(x, curved=curved)
        good = np.setdiff1d(np.arange(len(x)), one.unreliable)
        assert len(good) >= 5
        # Weights of a variance up to some ten among 400 draws: a standard error of
        # sqrt(10 / 400) = .16. Beyond k = .5 weights have no variance.
        known = np.flatnonzero(one.pareto_k < 0.5)
        assert len(known) >= 5
        np.testing.assert_allclose(one.density[known], expected[known], atol=4 * 0.16)
        np.testing.assert_allclose(one.density[good], expected[good], atol=5 * 0.16)
        error = 4 * 0.05 * math.sqrt(len(good))
        assert one.density[good].sum() == pytest.approx(expected[good].sum(), abs=error)
    assert found[1].total > found[0].total + 5


def test_a_trial_that_decides_the_posterior_is_unreliable():
    line = 0.8 + 0.4 * ACTION
    x = line.clone()
    x[-1] += 15.0
    loop = criticism(x)
    (one,) = leave_one_out(loop.rivals, loop.trace())[:1]
    assert 9 in one.unreliable
    clean = criticism(line)
    (one,) = leave_one_out(clean.rivals, clean.trace())
    assert 9 not in one.unreliable


def test_the_largest_shape_grows_with_the_draws():
    def limit(num: int) -> float:
        zero = np.zeros(2)
        return LeaveOneOut(
            name="none", density=zero, pareto_k=zero, num_draws=num
        ).largest_k

    assert limit(100) == pytest.approx(0.5)
    assert limit(NUM_DRAWS) == pytest.approx(1 - 1 / math.log10(NUM_DRAWS))
    assert limit(100_000) == 0.7
