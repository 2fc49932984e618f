"""Many parameters under declared noise against closed forms."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import norm
from torch.distributions import Independent, LogNormal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.inference import refine
from sbi_active.inference.declared.refining import SimulatedBelief
from sbi_active.inference.engine import SimulatedPotential, search
from sbi_active.inference.engine.potential import MeanTable, SimulatedLikelihood
from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.workers.settings import IN_PROCESS
from sbi_active.tasks import get_task


def test_uninformed_parameters_keep_their_prior():
    dim, known, action = 10, 4, torch.zeros(1, 1)
    with forked_generators(0):
        weight = torch.randn(8, known)

    def mean(theta, action):
        return theta[:, :known] @ weight.T

    prior = Independent(LogNormal(torch.zeros(dim), 0.4 * torch.ones(dim)), 1)
    simulator = SimulatorModel(mean, noise=GaussianNoise(0.5))
    x = mean(torch.ones(1, dim), action)
    belief = refine(simulator, prior, action, x, seed=0)
    assert isinstance(belief, SimulatedBelief)
    assert belief.free.tolist() == [False] * known + [True] * (dim - known)
    with forked_generators(3):
        draws = belief.sample((4_000,))[:, known:].log() / 0.4
    assert len(draws.unique(dim=0)) == 4_000  # fresh, not resampled
    assert float(draws.mean(0).abs().max()) < 0.06
    assert float((draws.std(0) - 1).abs().max()) < 0.05
    theta = torch.ones(2, dim)
    theta[1, known:] = 2.0
    before = prior.log_prob(theta)
    after = belief.log_prob(theta)
    assert float(after[1] - after[0]) == pytest.approx(
        float(before[1] - before[0]), abs=1e-3
    )


def test_searches_that_agree_on_a_wrong_place_go_on():
    seed = 138
    # Of these oscillations a quarter to one in sixty of the searches ends at the truth.
    task = get_task("chain", parameters=8)
    with forked_generators(seed, "truth"):
        task = task.with_truth(task.prior.sample())
    action = task.actions.sample((6,), seed=derive_seed(seed, "actions"))
    x = torch.stack(
        [task.real_system(a, seed=derive_seed(seed, i)) for i, a in enumerate(action)]
    )
    rng = np.random.default_rng(derive_seed(seed, "many"))
    c = NormalCoordinates(PriorCoordinates(task.prior, rng), rng)
    table = MeanTable(task.simulator, IN_PROCESS)
    likelihood = SimulatedLikelihood(table, action, x.double())
    found = search(SimulatedPotential(likelihood, c), rng)
    best, truth = likelihood(c.to_theta(found.modes[:1])), task.theta_true[None]
    assert float(best[0]) > float(likelihood(truth)[0]) - 3


def test_bounds_cut_a_posterior_along_thirty_axes():
    # Sums of two uniform numbers are measured: pairs are independent.
    pairs, sd = 15, 0.1
    x = torch.linspace(0.05, 1.95, pairs)[None]

    def sums(theta, action):
        return theta[:, ::2] + theta[:, 1::2]

    prior = BoxUniform(torch.zeros(2 * pairs), torch.ones(2 * pairs))
    simulator = SimulatorModel(sums, noise=GaussianNoise(sd))
    belief = refine(simulator, prior, torch.zeros(1, 1), x, seed=0)
    with forked_generators(0):
        theta = belief.sample((4_000,)).double().numpy()
    one = (np.arange(400) + 0.5) / 400
    a, b = np.meshgrid(one, one)
    log_evidence = 0.0
    for j, seen in enumerate(x[0].tolist()):
        density = norm.pdf(seen, a + b, sd)
        log_evidence += np.log(density.mean())
        weight = density / density.sum()
        mean = (weight * a).sum()
        width = np.sqrt((weight * (a - mean) ** 2).sum())
        correlation = (weight * (a - mean) * (b - mean)).sum() / width**2
        own = theta[:, 2 * j : 2 * j + 2]
        assert np.abs(own.mean(0) - mean).max() < 0.15 * width
        assert own.std(0) == pytest.approx([width, width], rel=0.1)
        assert np.corrcoef(own.T)[0, 1] == pytest.approx(correlation, abs=0.1)
    assert isinstance(belief, SimulatedBelief)
    assert belief.log_evidence == pytest.approx(log_evidence, abs=1.5)
    assert len(np.unique(theta[:, 0])) > 500
    # Nothing is tried in vain: of normal draws none lies within all bounds.
    assert belief.diagnostics.num_simulations < 12_000
