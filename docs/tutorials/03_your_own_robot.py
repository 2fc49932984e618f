# %% [markdown]
# # Your own simulator and robot
#
# Ask for an action, run it, tell the outcome. Trials are expensive, so each step is
# saved immediately, and a campaign that was killed continues where it stopped.
#
# A sled is pushed at some speed and slides. Its friction and drag are unknown.

# %%
import shutil

import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    SimulatorModel,
)


def slide(theta, action):  # m, shape (n, 2) and (n, 1) to (n, 1)
    friction, drag = theta[:, :1], theta[:, 1:]
    return action**2 / (2 * 9.81 * friction) / (1 + drag * action)


simulator = SimulatorModel(
    slide,
    noise=GaussianNoise(0.02),  # of the measurement, in the units of x
    parameter_names=["friction", "drag"],
    channel_names=["distance"],
)
prior = BoxUniform(torch.tensor([0.2, 0.0]), torch.tensor([1.0, 1.0]))
actions = BoxActions([0.5], [3.0], names=["speed"], units=["m/s"])

# %% [markdown]
# `SimulatorModel` owns the noise: the function gives the noise-free outcome. A plain
# function that draws its own noise is taken as well. Before the robot moves, one call
# checks shapes, seeds, parameters that change nothing and what a campaign costs:

# %%
from sbi_active.simulation import check_simulator

print(check_simulator(simulator, prior, actions))

# %% [markdown]
# ## Ask and tell

# %%
truth = torch.tensor([[0.4, 0.3]])


def robot(action, seed):  # yours moves
    return simulator(truth, action[None], seeds=torch.tensor([seed]))[0]


shutil.rmtree("sled", ignore_errors=True)
options = CampaignOptions(network="on demand")
with Campaign(
    simulator, prior, actions, directory="sled", seed=0, options=options
) as campaign:
    trial = campaign.ask()
    print("push at", trial.action, "m/s")
    campaign.tell(robot(trial.action, 0))  # on the disk before it returns
    trial = campaign.ask()  # this one is not told: the power fails

# %% [markdown]
# ## Resume
#
# Another process, another day: the trial that was asked for is still pending, and
# nothing is computed twice.

# %%
campaign = Campaign.load("sled", simulator=simulator)
print(campaign)
trial = campaign.ask()  # the same trial
campaign.tell(robot(trial.action, 1))
trial = campaign.ask()
campaign.tell([9.9])  # a slip of the hand
campaign.update()
for warning in campaign.belief.diagnostics.warnings:
    print("-", warning)

# %% [markdown]
# ## Correct
#
# The library never drops a trial silently, and a correction is a new line in the log.
# Results that depend on the trial are computed again.

# %%
campaign.correct(2, robot(campaign.history[2].action, 2), reason="read the wrong tape")
print(campaign.update())

# %%
_ = campaign.plot(theta_true=truth[0])
# %%
campaign.to_dataframe()[["speed [m/s]", "distance", "information_gained", "health"]]

# %%
campaign.close()

# %% [markdown]
# A trial that ran and gave no measurement (the sled fell off the table) is
# `tell(status="invalid")`, which is information. A fault that has nothing to do with
# the parameters is `tell(status="missing")`.
#
# ## From another language
#
# Any program that can call another drives the same folder by `--json`:

# %%
import json
import subprocess
import sys


def command(*words):
    call = [sys.executable, "-m", "sbi_active", *words]
    return subprocess.run(call, capture_output=True, text=True, check=True).stdout


status = json.loads(command("status", "sled", "--json"))
print(json.dumps(status["belief"]["parameters"], indent=1))

# %% [markdown]
# `ask` needs the simulator's file, `tell`, `status` and `correct` do not: the computer
# beside the robot needs no simulator. See [campaigns](../campaigns.md) for all
# commands, and `sbi-active report sled` for one page that can be sent.
