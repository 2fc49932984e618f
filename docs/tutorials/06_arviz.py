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
az.plot_pair(data, var_names=["theta"], kind="kde", figsize=(5, 4))
# %% [markdown]
# The posterior predictive beside what was observed:

# %%
az.plot_ppc(data, num_pp_samples=50, figsize=(6, 3.5))

# %% [markdown]
# Draws of a belief are independent, so that convergence is no question here:
# `belief.diagnostics` takes its place, and says how many effective draws are behind it
# and how far the belief is from that of endless simulations.
