# %% [markdown]
# # From the first alarm to a settled verdict
#
# A sled brakes on a floor. Its simulator has one friction; the real one grows with
# speed, and nobody declared that. A campaign tunes the simulator until a trial
# contradicts it. The loop then runs trials itself until its verdict is settled.

# %%
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
)
from sbi_active.criticism import Trials, close_loop, varying_parameters

GRAVITY, SENSOR = 9.81, torch.tensor([0.01, 0.005])  # m and s


def brake(theta, action):
    """Way (m) and time (s) to a stop, shape (n, 2), of a sled at a speed (m/s)."""
    friction, delay = theta[:, :1], theta[:, 1:]
    way = action**2 / (2 * GRAVITY * friction) + delay * action
    return torch.cat([way, action / (GRAVITY * friction) + delay], 1)


model = SimulatorModel(
    brake,
    noise=GaussianNoise(SENSOR),
    parameter_names=["friction", "delay"],
    channel_names=["way [m]", "time [s]"],
)
prior = BoxUniform(torch.tensor([0.1, 0.0]), torch.tensor([1.0, 0.3]))
actions = DiscreteActions(torch.linspace(0.5, 4.0, 15), names=["speed"], units=["m/s"])

# %% [markdown]
# The real sled, which the simulator does not know:

# %%
rng = torch.Generator().manual_seed(0)


def real_system(action):
    theta = torch.stack([0.3 + 0.04 * action[0], torch.tensor(0.1)])[None]
    x = brake(theta, action[None].float())[0]
    return x + SENSOR * torch.randn(2, generator=rng)


# %% [markdown]
# ## The first alarm
#
# Each outcome is compared with what the belief predicted before it was used. The most
# informative speed is the same each time, at which any friction fits: so every second
# trial is a check, far from all others.

# %%
options = CampaignOptions(check_every=2)
campaign = Campaign(model, prior, actions, options=options, seed=0)
for _ in range(4):
    trial = campaign.ask()
    campaign.tell(real_system(trial.action))
    campaign.update()
    print(f"{float(trial.action):.2f} m/s: {campaign.health}")

# %% [markdown]
# ## Trials that decide
#
# `varying_parameters` lets each parameter depend on the speed and on the order of the
# trials. The loop predicts a trial before it runs it, and stops when the verdict is
# probable and predicted the outcome.

# %%
told = campaign.state.trials
trials = Trials(
    torch.stack([trial.action for trial in told]),
    torch.stack([trial.x for trial in told]),
    action_labels=["speed [m/s]"],
)
effects = varying_parameters(model, prior, trials)
passive = close_loop(model, prior, trials, effects=effects, evaluate=False)
print(passive.probabilities)

# %%
report = close_loop(
    model,
    prior,
    trials,
    effects=effects,
    actions=actions,
    real_system=real_system,
    max_trials=6 - len(trials),
    evaluate=False,
)
print(report.verdict, "-", report.stopped)
for trial in report.tested:
    print(trial.action, *trial.in_words())

# %% [markdown]
# The report has the same as a table, "Predicted, then measured", and the size of the
# effect: 0.04 a m/s is .27 prior deviations from the middle of the range to its end.

# %%
report.parameters

# %% [markdown]
# `report.simulator` and `report.prior` are the simulator with the effect and the joint
# prior, for a campaign or `ASBI`. [Trials that
# decide](../closing_the_loop.md#trials-that-decide) has the conditions, and
# [the gate](../howto/gate.md) decides whether a simulator may be used.
