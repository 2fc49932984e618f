"""Refined beliefs of many parameters against closed forms."""

from __future__ import annotations

import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.seeding import forked_generators


def refined(dim: int, num: int, seed: int, num_histories: int):
    """Return (KL(exact, belief), belief) of a trial of x = A theta + .5 e."""
    with forked_generators(seed):
        weight = torch.randn(num, dim) / dim**0.5
        x = torch.randn(1, dim) @ weight.T + 0.5 * torch.randn(1, num)

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta @ weight.T + 0.5 * torch.randn(len(theta), num)

    prior = MultivariateNormal(torch.zeros(dim), torch.eye(dim))
    settings = RefinementOptions(num_histories=num_histories, num_effective=75)
    belief = refine(
        simulator, prior, torch.zeros(1, 1), x, settings=settings, seed=seed
    )
    design = weight.double()
    precision = torch.eye(dim).double() + design.T @ design / 0.25
    mean = torch.linalg.solve(precision, design.T @ x[0].double() / 0.25)
    exact = MultivariateNormal(mean, precision_matrix=precision)
    with forked_generators(0):
        theta = exact.sample(torch.Size([2_000]))
    log_ratio = exact.log_prob(theta) - belief.log_prob(theta.float()).double()
    return float(log_ratio.mean()), belief


def test_twenty_parameters():
    divergence, _ = refined(20, 2, seed=0, num_histories=200)
    assert -0.02 < divergence < 0.3


@pytest.mark.parametrize(("num", "num_histories"), [(2, 600), (80, 400)])
def test_trust_follows_the_error_and_not_the_dimension(num: int, num_histories: int):
    divergence, belief = refined(10, num, seed=1, num_histories=num_histories)
    diagnostics = belief.diagnostics
    assert diagnostics.error_nats == pytest.approx(divergence, rel=0.7, abs=0.05)
    assert diagnostics.trustworthy == (diagnostics.error_nats < 0.1)
    # What is off by more than a tenth of a nat is not to be trusted; the estimate of it
    # errs by a third.
    if not 0.07 < divergence < 0.15:
        assert diagnostics.trustworthy == (divergence < 0.1)


def refine_two_of(dim: int):
    """Return the belief of many parameters, of which a trial tells of two."""
    prior = BoxUniform(torch.zeros(dim), torch.ones(dim))

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta[:, :2] + 0.5 * torch.randn(len(theta), 2)

    settings = RefinementOptions(num_histories=200, num_effective=25)
    x = torch.full((1, 2), 0.5)
    return refine(simulator, prior, torch.zeros(1, 1), x, settings=settings, seed=0)


def test_too_few_histories_are_no_unexplained_outcome():
    with pytest.raises(ValueError, match=r"at least 342 histories for 150") as error:
        refine_two_of(150)
    assert not isinstance(error.value, UnexplainedOutcomeError)
