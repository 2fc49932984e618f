# %% [markdown]
# # Your own estimator, search, noise or effect
#
# Each in some twenty lines. The library takes them wherever it takes its own.

# %%
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)


def mean(theta, action):
    return theta * torch.sin(action)


prior = BoxUniform(torch.tensor([-1.0]), torch.tensor([1.0]))
listed = DiscreteActions(torch.linspace(0, 3, 13), names=["angle"], units=["rad"])
model = SimulatorModel(mean, noise=GaussianNoise(0.1))

# %% [markdown]
# ## An effect
#
# What a simulator may lack: where it acts (`hook`), how strong it may be (`prior`), the
# value at which it does nothing (`null`), and what it does.

# %%
from torch.distributions import Independent, Normal

from sbi_active.criticism import Effect, Trials, close_loop

zero = Effect(
    "zero of the angle",
    hook="action",
    prior=Independent(Normal(torch.zeros(1), 0.2 * torch.ones(1)), 1),
    null=0.0,
    apply=lambda action, phi, wanted, context: action + phi,
    units="rad",
    describe="the angle is commanded from a zero that is off",
)
angle = torch.linspace(0.2, 3.0, 10)[:, None]
rng = torch.Generator().manual_seed(0)
x = mean(torch.tensor([[0.7]]), angle + 0.3) + 0.1 * torch.randn((10, 1), generator=rng)
precise = SimulatorModel(mean, noise=GaussianNoise(0.1))
report = close_loop(precise, prior, Trials(angle, x), effects=[zero], actions=listed)
print(str(report).splitlines()[0])

# %% [markdown]
# ## A noise model
#
# A subclass of `NoiseModel` with a draw and a density. Row i depends on seed i alone.
# This one is uniform: a ruler that is read to the nearest mark.

# %%
import math

from sbi_active.simulation import NoiseModel


class RulerNoise(NoiseModel):
    """Uniform within half a mark around the noise-free outcome."""

    def __init__(self, mark):
        self.mark = mark

    def sample(self, mean, seeds=None):
        if seeds is None:
            share = torch.rand(mean.shape, dtype=mean.dtype)
        else:
            draws = [
                torch.rand(
                    mean.shape[1:], generator=torch.Generator().manual_seed(int(s))
                )
                for s in seeds
            ]
            share = torch.stack(draws).to(mean.dtype)
        return mean + self.mark * (share - 0.5)

    def log_prob(self, x, mean):
        inside = ((x - mean).abs() <= self.mark / 2).flatten(1)
        density = torch.where(inside, -math.log(self.mark), -torch.inf)
        return density.double().sum(1)


ruler = SimulatorModel(mean, noise=RulerNoise(0.1))
theta, action = torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0], [1.0]])
seeds = torch.tensor([3, 4])
print(ruler(theta, action, seeds=seeds)[:, 0], ruler(theta, action, seeds=seeds)[:, 0])

# %% [markdown]
# ## An estimator of information
#
# `_contributions` returns what each simulation (candidate a, draw n) contributes, in
# nats; the base class takes means, errors and rows without measurement into account.
# This one is the information of a linear-Gaussian world, by the correlation of x and
# theta over the draws.

# %%
from sbi_active.design import InformationGainEstimator


class CorrelationGain(InformationGainEstimator):
    """-log(1 - r^2) / 2, r the correlation of one parameter and one outcome."""

    bound = "none"
    needs_model = False

    def _contributions(self, model, simulations, belief):
        x = simulations.x.flatten(2)[..., 0].double()
        theta = simulations.theta[:, 0].double()
        x, theta = x - x.mean(1, keepdim=True), theta - theta.mean()
        r2 = (x * theta).mean(1) ** 2 / (x.square().mean(1) * theta.square().mean())
        return (-0.5 * torch.log1p(-r2))[:, None].expand(x.shape)


designer = InformationGainDesigner(listed, num_samples=500, estimator=CorrelationGain())
design = designer.select(None, model, belief=prior, seed=0)
print(design)

# %% [markdown]
# ## A search
#
# `finalists` proposes actions; the designer then simulates and compares them. This one
# draws at random in a continuous space.

# %%
from sbi_active.design import Search


class RandomSearch(Search):
    """The best of some random actions."""

    def __init__(self, num=20):
        self.num = num

    def size(self, actions):
        return self.num

    def finalists(self, objective):
        drawn = objective.actions.sample((self.num,), seed=objective.seed)
        return drawn[objective.permitted(drawn)]


space = BoxActions([0.0], [3.0], names=["angle"], units=["rad"])
designer = InformationGainDesigner(
    space, num_samples=300, estimator=CorrelationGain(), search=RandomSearch()
)
print(designer.select(None, model, belief=prior, seed=0).action, "where sin is largest")
