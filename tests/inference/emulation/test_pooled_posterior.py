"""The posterior of all trials from a pool of few simulations."""

import torch

from sbi_active import Campaign
from sbi_active.tasks import get_task


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
