"""The posterior of all trials from a pool of few simulations."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign
from sbi_active.inference.emulation.peaks import sample_posterior
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.tasks import get_task

DIM = 4
PLATEAU = -20.0  # log likelihood where nothing is known


# A needle that nothing points at is for no sampler.
@pytest.mark.parametrize(
    ("is_known", "width"), [(True, 0.003), (True, 0.05), (False, 0.05)]
)
def test_a_peak_on_a_plateau_is_not_lost(is_known, width):
    prior = BoxUniform(-torch.ones(DIM), torch.ones(DIM))
    rng = np.random.default_rng(0)
    c, center = PriorCoordinates(prior, rng), np.array([0.5, -0.2, 0.1, 0.6])

    def log_likelihood(z):
        square = ((z - center) ** 2).sum(1) / (2 * width**2)
        peak = -square - DIM * np.log(width * np.sqrt(2 * np.pi))
        return np.logaddexp(peak, PLATEAU)

    def log_joint(z):
        with np.errstate(invalid="ignore"):
            return np.where(c.inside(z), c.log_prior(z) + log_likelihood(z), -np.inf)

    likelihood: Any = SimpleNamespace(
        coordinates=c, log_likelihood=log_likelihood, log_joint=log_joint
    )
    known = center + 5 * width * rng.standard_normal((400, DIM))
    points = known if is_known else c.sample_prior(400, rng)
    found = sample_posterior(likelihood, points, rng)
    assert found.log_normalizer == pytest.approx(-DIM * np.log(2), abs=0.1)
    draws = found.resample(500, rng)
    assert draws.mean(0) == pytest.approx(center, abs=0.3 * width)


def test_few_simulations_know_a_mean_that_is_wide_beside_its_noise():
    task = get_task("numerical")  # at -5 outcomes differ by 15,000 deviations
    options = {"max_simulations": 200, "planned_trials": 2}
    c = Campaign(task.simulator, task.prior, task.actions, seed=3, options=options)
    actions, outcomes = torch.tensor([[-5.0], [5.0]]), []
    for k, action in enumerate(actions):
        outcomes.append(task.real_system(action, seed=k))
        c.tell(outcomes[-1], action=action)
        belief = c.update()
    exact = task.reference(actions, torch.stack(outcomes))
    theta = exact.sample(200, seed=0)
    off = exact.log_prob(theta) - belief.log_prob(theta.float()).double()
    assert float(off.abs().max()) < 0.3
    assert c.state.meter.spent <= 200
