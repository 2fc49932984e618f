"""What a refinement takes: priors, outcomes, settings, earlier simulations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sbi_active.inference import refine
from sbi_active.tasks.numerical.exact import ExactPosterior
from tests.inference.refinement.refined_worlds import BOX, numerical, observe


def test_a_constant_channel_does_no_harm():
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return torch.cat([numerical()(theta, action), torch.full_like(action, 3.0)], 1)

    action = torch.tensor([[-5.0], [5.0]])
    x = observe(simulator, torch.tensor([[-3.0, 1.0]]), action, 0)
    belief = refine(simulator, BOX, action, x, seed=0)
    exact = ExactPosterior(action.double(), x[:, :1])
    theta = exact.sample(1_000, seed=0)
    log_ratio = exact.log_prob(theta) - belief.log_prob(theta).double()
    assert float(log_ratio.mean()) < 0.1
    assert belief.diagnostics.trustworthy, belief.diagnostics.warnings


def test_deterministic_simulator_is_refused():
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        refine(
            lambda theta, action: theta[:, :1] * action,
            BOX,
            torch.ones(1, 1),
            torch.ones(1, 1),
            seed=0,
        )


def test_a_lack_of_memory_is_said(monkeypatch):
    def lacking(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")

    monkeypatch.setattr("sbi_active.inference.refinement.refining._learned", lacking)
    one = torch.ones(1, 1)
    with pytest.raises(MemoryError, match="belief of 2 parameters; got none left"):
        refine(numerical().__call__, BOX, one, one, seed=0)
