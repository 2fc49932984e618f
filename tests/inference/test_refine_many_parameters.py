"""Refined beliefs of many parameters against closed forms."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active.inference.refine import Refinement, refine
from sbi_active.seeding import forked_generators


def refined(dim: int, num: int, seed: int, num_histories: int):
    """Return (KL(exact, belief), belief) of a trial of x = A theta + .5 e."""
    with forked_generators(seed):
        weight = torch.randn(num, dim) / dim**0.5
        x = torch.randn(1, dim) @ weight.T + 0.5 * torch.randn(1, num)

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta @ weight.T + 0.5 * torch.randn(len(theta), num)

    prior = MultivariateNormal(torch.zeros(dim), torch.eye(dim))
    settings = Refinement(num_histories=num_histories)
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


@pytest.mark.parametrize("dim", [10, 20])
def test_ten_and_twenty_parameters(dim: int):
    divergence, _ = refined(dim, 4, seed=0, num_histories=600)
    assert -0.02 < divergence < 0.3
