# %% [markdown]
# # Clusters, banks, dear simulators
#
# Outcomes depend on the seed, the parameters and the action alone: not on the number
# of workers, nor on whether they are processes here or a cluster. So a run can be
# moved.

# %%
import tempfile

import torch
from sbi.utils import BoxUniform

from sbi_active import Bank, GaussianNoise, SimulatorModel, simulate

model = SimulatorModel(
    lambda theta, action: action**2 / (2 * 9.81 * theta), noise=GaussianNoise(0.01)
)
prior = BoxUniform(torch.tensor([0.1]), torch.tensor([1.0]))
theta, action = prior.sample((400,)), torch.full((400, 1), 2.0)
here = simulate(model, theta, action, seed=0)
here.counts

# %% [markdown]
# ## On a Dask cluster
#
# By one line of joblib's configuration. This page starts a cluster of one thread in
# its own process; yours is `distributed.Client("scheduler:8786")`.

# %%
import distributed
import joblib

with (
    distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster,
    distributed.Client(cluster),
    joblib.parallel_config(backend="dask"),
):
    there = simulate(model, theta, action, seed=0, workers=2)
torch.equal(here.x, there.x)

# %% [markdown]
# A row that raises, hangs (`Workers(time_limit=)`) or kills its process is *missing*,
# with its traceback, and costs no other row:


# %%
def fragile(theta, action, rng):
    if theta[0] < 0.15:
        raise RuntimeError("the contact solver diverged")
    return action**2 / (2 * 9.81 * theta)


rows = simulate(
    SimulatorModel(fragile, noise=GaussianNoise(0.01), batched=False),
    theta,
    action,
    seed=0,
)
print(rows.counts)

# %% [markdown]
# ## A bank
#
# Dear rows are kept on the disk and used again, weighted for another prior. What
# `simulate` has reported as stored survives a kill.

# %%
from sbi_active.simulation import reuse

folder = tempfile.mkdtemp()
with Bank(folder, simulator=model) as bank:
    simulate(model, theta, action, seed=0, store=bank.drawn_from(prior))
    narrower = BoxUniform(torch.tensor([0.3]), torch.tensor([0.5]))
    reused = reuse(bank, narrower)
print(
    f"{len(theta)} rows of the wide prior, {reused.effective_sample_size:.0f} of the "
    "narrow one"
)

# %% [markdown]
# ## A simulator that takes a minute
#
# `max_simulations` is a budget for the whole campaign, never exceeded: belief, designs
# and scores share one pool of rows, which Gaussian processes interpolate.
# `planned_trials` is how many trials it is to last for.

# %%
from sbi_active import Campaign, CampaignOptions, DiscreteActions

actions = DiscreteActions([1.0, 2.0, 3.0], names=["speed"], units=["m/s"])
options = CampaignOptions(max_simulations=200, planned_trials=2)
campaign = Campaign(model, prior, actions, seed=0, options=options)
truth = torch.tensor([[0.4]])
campaign.run(lambda action: model(truth, action[None])[0], num_rounds=2)
print(campaign.belief)
print("simulated", campaign.state.meter.spent, "of", options.max_simulations)

# %% [markdown]
# With `directory="folder"` and `workers=Workers(8, time_limit=600)` these rows are
# kept, run side by side and given up after ten minutes: see [how
# many](../howto/how_many_simulations.md).
