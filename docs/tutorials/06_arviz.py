# %% [markdown]
# # ArviZ: pair plots, predictive checks, summaries
#
# A belief or a whole campaign becomes ArviZ's own format, with names of parameters,
# actions and trials as coordinates. From there all of ArviZ applies.

# %%
import arviz as az
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
    to_inference_data,
)

model = SimulatorModel(
    lambda theta, speed: speed**2 / (2 * 9.81 * theta[:, :1]) * (1 - theta[:, 1:] / 2),
    noise=GaussianNoise(0.01),
    parameter_names=["friction", "loss"],
)
prior = BoxUniform(torch.tensor([0.1, 0.0]), torch.tensor([1.0, 1.0]))
actions = DiscreteActions([1.0, 2.0, 3.0], names=["speed"], units=["m/s"])
options = CampaignOptions(network="on demand")
campaign = Campaign(model, prior, actions, seed=0, options=options)
truth = torch.tensor([[0.4, 0.3]])
campaign.run(lambda action: model(truth, action[None])[0], num_rounds=2)
data = to_inference_data(campaign)
data

# %%
az.summary(data, kind="stats")

# %% [markdown]
# Friction and loss enter here as one combination alone, so that their pair plot is a
# ridge, and the diagnostics say which combination is known:

# %%
print(campaign.belief.diagnostics)

# %%
_ = az.plot_pair(data, var_names=["theta"], kind="kde", figsize=(5, 4))
# %% [markdown]
# The posterior predictive beside what was observed:

# %%
_ = az.plot_ppc(data, num_pp_samples=50, figsize=(6, 3.5))

# %% [markdown]
# `to_datatree` gives the same as a tree of xarray, which ArviZ 1.x reads and which
# needs no ArviZ at all:

# %%
from sbi_active import to_datatree

tree = to_datatree(campaign)
print(", ".join(tree.children))
tree["posterior"]["theta"].mean(("chain", "draw")).to_series().round(3)

# %% [markdown]
# Draws of a belief are independent, so that convergence of chains is no question here.
# `belief.diagnostics` says how many effective draws are behind it and how far it is
# from that of endless simulations.
#
# ## Can the network be trusted, and at which actions?
#
# `check_calibration` draws parameters from the prior and outcomes at every action, and
# judges ranks, coverage and the nats that the network loses, each with its interval:

# %%
from sbi_active import ASBI, MixtureDensity
from sbi_active.diagnostics import check_calibration

inference = ASBI(prior, density_estimator=MixtureDensity(num_iterations=300))
theta, pushed = prior.sample((2_000,)), actions.sample((2_000,))
inference.append_simulations(theta, model(theta, pushed), action=pushed).train()
calibration = check_calibration(inference, model, actions=actions, num_simulations=300)
print(calibration)

# %%
_ = calibration.plot()
# %% [markdown]
# A network of 300 steps and few rows is quick, and what it loses is said. Refined
# beliefs are checked by `check_belief`: see [can it be trusted](../trust.md).
