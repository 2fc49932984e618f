"""Which of several rival models is right, against quadrature.

The estimate is a lower bound, reached within three standard errors for Gaussian
predictives, and for long outcomes within a stated slack.
"""

import math
from dataclasses import dataclass

import pytest
import torch

from sbi_active.design import ModelIndexGain
from sbi_active.design.estimators.model_index import RivalSampler

ACTIONS = torch.tensor([[0.0], [0.5], [1.0], [2.0]])
X = torch.linspace(-30, 30, 60_001).double()


@dataclass
class Gaussian:
    """A predictive N(slope a, (1 + growth a)^2), without a measurement at times."""

    probability: float
    slope: float
    growth: float = 0.0
    lost: float = 0.0

    def predict(self, action, num_samples, seed):
        generator = torch.Generator().manual_seed(seed)
        x = torch.randn(num_samples, 1, generator=generator)
        x = self.slope * action + (1 + self.growth * action) * x
        x[torch.rand(num_samples, generator=generator) < self.lost] = torch.nan
        return x

    def log_joint(self, action):
        density = torch.distributions.Normal(
            self.slope * action, 1 + self.growth * action
        ).log_prob(X)
        return density + math.log((1 - self.lost) * self.probability)


PAIR = [Gaussian(0.5, 0.0), Gaussian(0.5, 1.0)]
THREE = [Gaussian(0.8, 0.0), Gaussian(0.15, 1.0), Gaussian(0.05, -1.0, growth=1.0)]
LOSSY = [Gaussian(0.6, 0.0, lost=0.1), Gaussian(0.4, 1.0, lost=0.4)]


def information(rivals):
    p = torch.tensor([rival.probability for rival in rivals]).double()
    lost = p * torch.tensor([rival.lost for rival in rivals])
    gains = []
    for a in ACTIONS[:, 0].double():
        log_joint = torch.stack([rival.log_joint(a) for rival in rivals])
        log_ratio = log_joint.log_softmax(0) - p.log()[:, None]
        gain = (log_joint.exp() * log_ratio).sum() * (X[1] - X[0])
        gains.append(gain + torch.special.xlogy(lost, lost / lost.sum() / p).nansum())
    return torch.stack(gains)


def estimate(rivals, num_samples, seed=0):
    sampler = RivalSampler(rivals, seed)
    rows = sampler.draw(num_samples, ACTIONS)
    gain = ModelIndexGain(sampler.probability)(None, rows, None)
    return gain.mean(1), gain.std(1) / gain.shape[1] ** 0.5


@pytest.mark.parametrize("rivals", [PAIR, THREE, LOSSY], ids=["two", "three", "lossy"])
def test_quadrature(rivals):
    exact = information(rivals)
    for num_samples in (400, 1_200):
        gain, error = estimate(rivals, num_samples)
        assert ((gain - exact).abs() < 3 * error + 0.01).all()
    assert gain.argsort().tolist() == exact.argsort().tolist()


@dataclass
class Trajectory:
    """A correlated trajectory of 200 numbers, a small wave on it or not."""

    probability: float
    wave: float

    def predict(self, action, num_samples, seed):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(200, num_samples, generator=generator).double()
        return (self.wave * action * WAVE + (FACTOR @ noise).T)[..., None]


TIMES = torch.linspace(0, 1, 200).double()
WAVE = torch.sin(25 * TIMES)
SPREAD = (-(TIMES[:, None] - TIMES).abs() / 0.3).exp() + 0.01 * torch.eye(200)
FACTOR = torch.linalg.cholesky(SPREAD)


def test_a_difference_hidden_in_a_long_trajectory():
    """The wave is small beside the spread, in a direction that has little of it."""
    rivals = [Trajectory(0.5, 0.0), Trajectory(0.5, 0.4)]
    sampler = RivalSampler(rivals, 0)
    rows = sampler.draw(900, ACTIONS[:3])
    assert rows.x.shape == (3, 900, 200, 1)
    gain = ModelIndexGain(sampler.probability)(None, rows, None)
    error = gain.std(1) / gain.shape[1] ** 0.5
    distance = float((0.4 * WAVE) @ torch.linalg.solve(SPREAD, 0.4 * WAVE)) ** 0.5
    exact = []
    for a in (0.0, 0.5, 1.0):  # one discriminating number, N(+-, 1)
        pair = [Gaussian(0.5, 0.0), Gaussian(0.5, distance * a)]
        log_joint = torch.stack([r.log_joint(torch.tensor(1.0)) for r in pair])
        ratio = log_joint.log_softmax(0) + math.log(2)
        exact.append(float((log_joint.exp() * ratio).sum() * (X[1] - X[0])))
    exact = torch.tensor(exact)
    assert (gain.mean(1) <= exact + 3 * error).all()
    assert (gain.mean(1) > exact - 0.1 - 3 * error).all()


@dataclass
class Mixed:
    """A predictive of 60 posterior draws' means, drawn again and again, and noise."""

    probability: float
    center: float
    spread: float
    noise: float = 1.0

    def predict(self, action, num_samples, seed):
        generator = torch.Generator().manual_seed(seed)
        mean = self.center + self.spread * torch.randn(60, generator=generator)
        mean = mean[torch.randint(60, (num_samples,), generator=generator)]
        mean = (mean * action)[:, None]
        sd = torch.full_like(mean, self.noise)
        generator = torch.Generator().manual_seed(seed + 1)
        x = mean + sd * torch.randn(num_samples, 1, generator=generator)
        return x, mean, sd


def test_draws_that_stand_for_the_same_parameters_tell_nothing_by_it():
    """Two posteriors of few draws, far apart: each outcome is near one draw."""
    rivals = [Mixed(0.5, 0.0, 50.0, 0.01)] * 2
    gains = torch.stack([estimate(rivals, 400, seed)[0] for seed in range(4)])
    error = gains.std(0) / 4**0.5
    assert (gains.mean(0) < 3 * error + 0.02).all()
