# %% [markdown]
# # Closing the loop on measured data
#
# What if the simulator is wrong? Here a servo swings a pendulum. Its simulator has no
# friction. The loop finds the residual that no choice of parameters removes, traces it
# to an effect, adds the effect, and reports the error before and after on trials that
# had no part in it.
#
# The recordings that the committed results rest on are not part of the package, so that
# this page makes a stand-in: a pendulum in plain Python with friction that its model
# does not know. With the recordings, `python -m benchmarks measured.servo_pendulum
# --data DIR` does the same on the real machine: see
# [the servo](../measured.md#servo) for what came out, and
# [ball and hoop](../measured.md#motor-with-a-heavy-hoop) for a machine from its raw file on.

# %%
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal, Independent

from sbi_active import BoxActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect, Trials, close_loop, generic_effects

TIMES = torch.linspace(0.1, 2.0, 20)
STEP = 0.01


def swing(theta, action, *, friction=None, brake=None):
    """Angles (n, 20) of a released pendulum; theta is its frequency in 1/s."""
    n = len(theta)
    viscous = torch.zeros(n) if friction is None else friction.reshape(-1)
    dry = torch.zeros(n) if brake is None else brake.reshape(-1)
    angle, speed, rows = action[:, 0].clone(), torch.zeros(n), []
    for k in range(round(2.0 / STEP)):
        force = -(theta[:, 0] ** 2) * torch.sin(angle)
        force = force - viscous * speed - dry * torch.tanh(speed / 0.05)
        speed = speed + STEP * force
        angle = angle + STEP * speed
        if (k + 1) % 10 == 0:
            rows.append(angle)
    return torch.stack(rows, dim=1)


model = SimulatorModel(
    swing,
    noise=GaussianNoise(0.01),  # rad, of the encoder
    parameter_names=["frequency"],
    sample_times=TIMES,
)
prior = BoxUniform(torch.tensor([3.0]), torch.tensor([7.0]))
actions = BoxActions([0.2], [1.5], names=["release"], units=["rad"])

# %% [markdown]
# Eight "measured" releases, of which five are fitted; the truth has viscous friction of
# 0.4 per second.

# %%
release = torch.tensor([1.2, 0.3, 0.9, 0.6, 1.5, 0.5, 1.0, 1.4])[:, None]
rng = torch.Generator().manual_seed(0)
truth = torch.full((8, 1), 5.0)
x = swing(truth, release, friction=torch.full((8,), 0.4))
x = x + 0.01 * torch.randn(x.shape, generator=rng)
trials = Trials(release, x, role=["fit"] * 5 + ["held out"] * 3, sample_times=TIMES)

# %% [markdown]
# Effects are declared, each with a prior and the value at which it does nothing:

# %%
rate = Independent(HalfNormal(torch.tensor([1.0])), 1)
effects = [
    Effect.keyword("friction", prior=rate, units="1/s", describe="viscous friction"),
    Effect.keyword("brake", prior=rate, units="1/s^2", describe="dry friction"),
    *generic_effects(model, actions, prior=prior),
]
report = close_loop(model, prior, trials, effects=effects, actions=actions, seed=0)
print("\n".join(str(report).splitlines()[:14]))

# %%
report.before_after

# %% [markdown]
# `report.simulator` and `report.prior` are the augmented simulator and the joint prior:
# a campaign or `ASBI` takes them as they are. `report.save("found")` writes one page
# that can be sent. What the verdict is conditional on, and what it cannot know, stands
# in [closing the loop](../closing_the_loop.md).
