# %% [markdown]
# # Swap SNPE for ASBI
#
# sbi's own first example with one line changed, and then with actions. Nothing that
# works with sbi stops working: without `action=`, `ASBI` *is* sbi's `NPE_C`, with the
# same numbers at the same seed.
#
# Sizes here are small, so that the page is executed in seconds.

# %%
import torch
from sbi.utils import BoxUniform

from sbi_active import ASBI as SNPE  # the line that changes

prior = BoxUniform(-2 * torch.ones(3), 2 * torch.ones(3))


def simulator(theta):
    return theta + 1.0 + torch.randn_like(theta) * 0.1


torch.manual_seed(0)
theta = prior.sample((500,))
inference = SNPE(prior, density_estimator="mdn", show_progress_bars=False)
inference.append_simulations(theta, simulator(theta)).train(max_num_epochs=30)
posterior = inference.build_posterior()
draws = posterior.sample((1_000,), x=torch.ones(3), show_progress_bars=False)
draws.mean(0), draws.std(0)

# %% [markdown]
# `posterior` is sbi's own `DirectPosterior`, and the outcome `x = 1` means parameters
# near 0.
#
# ## With an action
#
# Now the robot chooses what it does. A simulator takes the parameters, shape
# `(n, theta_dim)`, and the actions, shape `(n, action_dim)`. Here the action decides
# how much of each parameter shows.

# %%
from sbi_active import ASBI, DiscreteActions, InformationGainDesigner

prior = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
truth = torch.tensor([[-3.0, 1.0]])


def simulator(theta, action):
    mean = theta[:, :1] * torch.exp(3 - action) + theta[:, 1:] * action
    return mean + torch.randn(len(theta), 1)


designer = InformationGainDesigner(
    DiscreteActions(torch.arange(-5, 5.5, 0.5)), num_samples=500
)
inference = ASBI(prior)
belief = prior
for trial in range(2):
    theta = belief.sample((2_000,))
    action = designer.actions.sample((2_000,))
    x = simulator(theta, action)
    inference.append_simulations(theta, x, action=action, belief=belief).train()
    design = designer.select(inference.build_posterior(), simulator, belief=belief)
    x_o = simulator(truth, design.action[None])[0]  # the robot's trial
    belief = inference.update(x_o, action=design.action, simulator=simulator)
    print(f"trial {trial}: action {design.action.tolist()}, {belief}")

# %% [markdown]
# The same four calls as in sbi, `append_simulations`, `train`, `build_posterior` and
# `sample`, and two more: `select` picks the action, `update` takes the outcome.
# Code that knows posteriors of x alone (`set_default_x`, sbi's own checks and plots)
# takes `inference.build_posterior().at(action)`.
#
# `belief` is a `torch.distributions.Distribution`; what was found about its quality
# stands in

# %%
print(belief.diagnostics)

# %% [markdown]
# The picture shows what each action was expected to tell in the last round:

# %%
_ = design.plot().set_title("expected information of each action, second trial")

# %% [markdown]
# A [campaign](03_your_own_robot.py) does these steps by itself.
