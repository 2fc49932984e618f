# %% [markdown]
# # A robot model
#
# From an MJCF to a belief and to what the model lacks: parameters are quantities of the
# model by their names, effects are enumerated from it.
#
# A leg of a Go2 was treated so on recorded data, see [its page](../measured.md#legs-of-a-quadruped).
# Here the robot is a pendulum, small enough for a page. Data in the form of
# `mujoco.sysid` enter by `sbi_active.mujoco.from_sysid`
# ([how](../robots.md#from-mujoco-sysid)).

# %%
import torch

from sbi_active import Campaign, CampaignOptions, DiscreteActions
from sbi_active.mujoco import from_mjcf, mjcf_effects, randomization

PENDULUM = """<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody>
  <body name="arm"><joint name="hinge" axis="0 1 0" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/></body>
  </worldbody></mujoco>"""

robot = from_mjcf(
    PENDULUM,
    {"damping": (0.0, 0.1, "hinge.damping"), "mass": (0.2, 1.0, "arm.mass")},
    actions=DiscreteActions([0.5, 1.0, 1.5], names=["hinge"]),
    sensors=["hinge"],
    times=[0.3, 0.6, 0.9, 1.2, 1.5],
    noise=0.005,
)
print(robot.simulator.parameter_names, robot.actions)

# %% [markdown]
# `from_mjcf` returns what everything else takes: simulator, prior and actions. What no
# release can tell is said before the first trial:

# %%
from sbi_active.simulation import check_simulator

print(*check_simulator(robot.simulator, robot.prior, robot.actions).warnings, sep="\n")

# %% [markdown]
# A campaign in simulation:

# %%
truth = torch.tensor([[0.05, 0.6]])
options = CampaignOptions(network="on demand")
campaign = Campaign(
    robot.simulator, robot.prior, robot.actions, seed=0, options=options
)
campaign.run(lambda a: robot.simulator(truth, a[None])[0], num_rounds=2)
print(campaign.belief)
print(randomization(campaign.belief, [0.5, 0.9]).ranges)

# %% [markdown]
# `randomization` gives ranges for domain randomization, and joint draws.
#
# ## What the model may lack
#
# Enumerated from the model's own joints, actuators and bodies, with priors scaled by
# what the model says of itself:

# %%
effects = mjcf_effects(robot)
for effect in effects[:12]:
    print(f"{effect.name:40} [{effect.units}]")
len(effects)

# %% [markdown]
# `close_loop(robot.simulator, robot.prior, trials, effects=effects)` then says which of
# them the measured trials point to: [robots](../robots.md#what-the-model-lacks).
