# %% [markdown]
# # Pouring in PyBullet, summaries as actions
#
# The paper's second robot task: a bucket of cubes is poured on the ground, and
# friction, rolling friction and restitution are to be found from a depth image. Which
# summary of the image the belief rests on is part of what is chosen.
#
# Reduced sizes: five cubes instead of 100, four settings of the bucket instead of 27,
# a budget of some hundred pours, two trials. What was measured with 100 cubes, and
# what falls short there, stands in [pouring](../pouring.md).

# %%
import importlib.util

import matplotlib.pyplot as plt
import torch
from sklearn.decomposition import PCA

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    MixedActions,
    SimulatorModel,
)
from sbi_active.actions import SummaryAction
from sbi_active.tasks import get_task

installed = importlib.util.find_spec("pybullet") is not None
if not installed:
    print("PyBullet is not installed: pip install 'sbi-active[pybullet]'")

# %% [markdown]
# The raw outcome is the image, 150 x 150 heights in mm, as one row:

# %% mystnb={"image": {"alt": "Depth image of cubes on the ground after a pour"}}
if installed:
    task = get_task("pouring", cubes=5, target=1)
    image = task.real_system(torch.tensor([20.0, 0.0, 5.0]), seed=0)
    figure, axes = plt.subplots(figsize=(4, 3.5))
    drawn = axes.imshow(image.reshape(150, 150), extent=(-15, 15, -15, 15))
    axes.set(xlabel="y [cm]", ylabel="x [cm]")
    figure.colorbar(drawn, label="height [mm]")

# %% [markdown]
# Summaries are functions of raw rows, or objects with `fit` and `transform`, of which
# copies are fitted to the simulations of a round. `SummaryAction` joins them with what
# the robot does, and adds an entry to the action, which the simulator leaves aside. It
# runs once for all summaries, so that the choice costs nothing.


# %%
def covered(images):  # (n, 22500) -> (n, 3): share in view, its mean place and spread
    """Return how much of the view is covered, and how far from the middle."""
    mask = (images > 0.5).float()
    far = torch.linspace(-1, 1, 150).square()
    radius = (far[:, None] + far[None, :]).sqrt().reshape(-1)
    share = mask.mean(1)
    return torch.stack(
        [share, (mask * radius).sum(1) / mask.sum(1).clamp(min=1), mask.amax(1)], 1
    )


if installed:
    settings = [[20.0, 0, 0.5], [20.0, 0, 5.0], [140.0, 0, 0.5], [140.0, 0, 5.0]]
    pours = DiscreteActions(
        settings, names=task.actions.names, units=task.actions.units
    )

    def pour(theta, action, *, seeds):
        return task.pours.images(theta, action[:, :3], seeds=seeds)

    simulator = SimulatorModel(pour, parameter_names=task.simulator.parameter_names)
    summaries = {"cover": covered, "principal components": PCA(4, random_state=0)}
    actions = MixedActions(pours, SummaryAction(summaries))
    options = CampaignOptions(max_simulations=200, planned_trials=2)
    campaign = Campaign(simulator, task.prior, actions, seed=0, options=options)
    for k in range(2):
        trial = campaign.ask()
        campaign.tell(task.real_system(trial.action[:3], seed=k))
        belief = campaign.update()
        print(dict(zip(actions.names, trial.action.tolist(), strict=True)))

# %% [markdown]
# What each summary was expected to tell, at each setting of the first trial:

# %%
if installed:
    print(campaign.history[0].design)
    print("simulated", campaign.state.meter.spent, "of", options.max_simulations)
    print(belief)

# %% [markdown]
# Five cubes and a few hundred pours tell little, and the belief says how far it is to
# be trusted:

# %%
if installed:
    print(belief.diagnostics)
