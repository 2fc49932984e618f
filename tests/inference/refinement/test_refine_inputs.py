"""What a refinement takes: priors, outcomes, settings, earlier simulations."""

from __future__ import annotations

import math

import pytest
import torch
from sbi.utils import MultipleIndependent
from sbi.utils.sbiutils import within_support
from torch import Tensor
from torch.distributions import (
    Gamma,
    Independent,
    LogNormal,
    Uniform,
)

from sbi_active.inference import refine
from sbi_active.seeding import forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.numerical.exact import ExactPosterior
from tests.inference.refinement.refined_worlds import BOX, draws, numerical, observe


def test_priors_with_one_bound_or_mixed_parts():
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return theta * action + 0.05 * torch.randn_like(theta)

    truth = torch.tensor([[0.8, 2.0]])
    action = torch.ones(2, 1)
    with forked_generators(0):
        x = simulator(truth.expand(2, -1), action)
    for prior in (
        Independent(LogNormal(torch.zeros(2), 1.0), 1),
        MultipleIndependent(
            [Uniform(torch.zeros(1), torch.ones(1)), Gamma(2 * torch.ones(1), 1.0)]
        ),
    ):
        belief = refine(simulator, prior, action, x, seed=0)
        sample = draws(belief, 4_000)
        assert bool(within_support(prior, sample).all())
        # Deviation .05 / sqrt(2) = .035 for each; the prior is flat at that scale.
        center = sample.median(0).values
        assert (center - x.mean(0)).abs().max() < 0.02
        # At the peak of a Gaussian of that deviation, in two dimensions.
        peak = -math.log(2 * math.pi * 0.05**2 / 2)
        assert float(belief.log_prob(center[None])[0]) == pytest.approx(peak, abs=0.2)


def test_invalid_simulations_are_counted():
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        x = numerical()(theta, action)
        return torch.where(theta[:, :1] > 0, x, torch.nan)

    action = torch.tensor([[0.0], [5.0]])
    x = observe(numerical(), torch.tensor([[2.0, 1.0]]), action, 0)
    belief = refine(simulator, BOX, action, x, seed=0)
    assert 0.1 < belief.diagnostics.share_invalid < 0.5
    assert abs(float(draws(belief, 2_000)[:, 0].median()) - 2.0) < 0.2
    with pytest.raises(ValueError, match="with a measurement"):
        refine(lambda t, a: torch.full((len(t), 1), torch.nan), BOX, action, x, seed=0)


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


@pytest.mark.parametrize(
    ("action", "x", "match"),
    [
        (torch.zeros(2), torch.zeros(2, 1), r"expected action \(t, action_dim\)"),
        (torch.zeros(2, 1), torch.zeros(3, 1), "as many trials"),
        (torch.zeros(0, 1), torch.zeros(0, 1), "at least one"),
        (torch.zeros(1, 1), torch.zeros(1, 3), "expected simulated x of shape"),
    ],
)
def test_bad_trials_are_refused(action: Tensor, x: Tensor, match: str):
    with pytest.raises(ValueError, match=match):
        refine(numerical(), BOX, action, x, seed=0)


def test_deterministic_simulator_is_refused():
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        refine(
            lambda theta, action: theta[:, :1] * action,
            BOX,
            torch.ones(1, 1),
            torch.ones(1, 1),
            seed=0,
        )


def counted(simulator):
    """Return a simulator that counts its rows, and the count."""
    count = [0]

    def wrapped(theta, action):
        count[0] += len(theta)
        return simulator(theta, action)

    return wrapped, count


def test_past_histories_are_used_first():
    """The belief of four trials from that of three: fewer rows, the same posterior."""
    task = get_task("numerical")
    action = torch.tensor([[-5.0], [5.0], [-5.0], [4.0]])
    x = torch.stack([task.real_system(a, seed=i) for i, a in enumerate(action)])
    exact = task.reference(action, x)
    theta = exact.sample(4_000, seed=0)
    rows, divergences = [], []
    for reuse in (True, False):
        past = None
        for t in (3, 4):
            simulator, count = counted(task.simulator)
            belief = refine(
                simulator, task.prior, action[:t], x[:t],
                past=past if reuse else None, seed=t,
            )  # fmt: skip
            past = belief.histories
            assert belief.diagnostics.num_simulations == count[0]
        rows.append(count[0])
        difference = exact.log_prob(theta) - belief.log_prob(theta.float())
        divergences.append(float(difference.mean()))
    assert rows[0] < 0.6 * rows[1]
    assert max(divergences) < 0.08


def test_a_lack_of_memory_is_said(monkeypatch):
    def lacking(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")

    monkeypatch.setattr("sbi_active.inference.refinement.refining._learned", lacking)
    one = torch.ones(1, 1)
    with pytest.raises(MemoryError, match="belief of 2 parameters; got none left"):
        refine(numerical().__call__, BOX, one, one, seed=0)
