"""Problems whose posterior is known by another way, to judge a belief's flag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active import GaussianNoise, SimulatorModel

Array = NDArray[Any]

TIMES = np.arange(1.0, 9.0)
DOSES = (0.0, 0.25, 0.5, 0.75)
COMPARTMENT_SD, OSCILLATION_SD = 0.02, 0.05


def compartments(theta: Array, dose: Array) -> Array:
    r"""Return amounts in a chain of compartments at eight times.

    .. math::
        \dot y_i = k_{i - 1} y_{i - 1} - k_i y_i, \qquad k = 10^\theta,

    from one unit in the compartment at ``dose``, by Runge-Kutta steps of .1.

    Args:
        theta: Shape (n, d), within [-1, 1].
        dose: Place of the dose along the chain, shape (n,), within [0, 1).
    """
    rate = 10.0**theta
    n, d = rate.shape
    seen = np.unique(np.rint(np.linspace(0, d - 1, min(d, 4))).astype(int))
    amount = np.zeros((n, d))
    amount[np.arange(n), np.minimum((dose * d).astype(int), d - 1)] = 1.0

    def slope(y: Array) -> Array:
        flow = rate * y
        return np.concatenate([-flow[:, :1], flow[:, :-1] - flow[:, 1:]], 1)

    rows, step = [], 0.1
    for _ in TIMES:
        for _ in range(10):
            a = slope(amount)
            b = slope(amount + step / 2 * a)
            c = slope(amount + step / 2 * b)
            e = slope(amount + step * c)
            amount = amount + step / 6 * (a + 2 * b + 2 * c + e)
        rows.append(amount[:, seen])
    return np.concatenate(rows, 1)


def oscillations(theta: Array, stretch: Array) -> Array:
    r"""Return a sum of damped oscillations at sixteen times.

    .. math::
        x(t) = \sum_j A_j e^{-t c_j} \cos(2 \pi f_j t), \qquad
        A_j = 1 + \theta_{2j} / 2, \; c_j = e^{\theta_{2j + 1}} / 4, \;
        f_j = .2 (j + 1),

    where a last parameter without a partner is an offset.

    Args:
        theta: Shape (n, d), within [-1, 1].
        stretch: Factor of the times less one, shape (n,).
    """
    n, d = theta.shape
    time = (1 + stretch[:, None]) * np.linspace(0.1, 3.0, 16)
    x = np.zeros((n, 16)) + (theta[:, -1:] if d % 2 else 0.0)
    for j in range(d // 2):
        size, decay = 1 + theta[:, [2 * j]] / 2, np.exp(theta[:, [2 * j + 1]]) / 4
        x += size * np.exp(-time * decay) * np.cos(0.4 * np.pi * (j + 1) * time)
    return x


FAMILIES = {
    "compartments": (compartments, COMPARTMENT_SD),
    "oscillations": (oscillations, OSCILLATION_SD),
}


@dataclass(frozen=True)
class Problem:
    """Trials of a family with declared noise, or noise that the simulator draws.

    Attributes:
        family: Name in ``FAMILIES``.
        dim: Number of parameters.
        seed: Seed of the truth and of the noise.
        is_declared: Whether the noise is declared.
    """

    family: str
    dim: int
    seed: int
    is_declared: bool = True

    @property
    def prior(self) -> BoxUniform:
        """Uniform in [-1, 1]."""
        return BoxUniform(-torch.ones(self.dim), torch.ones(self.dim))

    @property
    def action(self) -> Tensor:
        """Executed actions, shape (4, 1)."""
        return torch.tensor(DOSES)[:, None]

    @property
    def sd(self) -> float:
        """Standard deviation of the noise."""
        return FAMILIES[self.family][1]

    def mean(self, theta: Array, action: Array) -> Array:
        """Return noise-free outcomes, shape (n, q)."""
        return FAMILIES[self.family][0](theta, action)

    @property
    def x(self) -> Array:
        """Observed outcomes, shape (4, q)."""
        rng = np.random.default_rng([self.dim, self.seed, len(self.family)])
        truth = np.repeat(rng.uniform(-0.8, 0.8, (1, self.dim)), len(DOSES), 0)
        clean = self.mean(truth, np.array(DOSES))
        return clean + self.sd * rng.standard_normal(clean.shape)

    def residual(self, theta: Array) -> Array:
        """Return residuals in deviations of the noise, shape (n, 4 q)."""
        n, t = len(theta), len(DOSES)
        clean = self.mean(np.repeat(theta, t, 0), np.tile(DOSES, n))
        return (clean.reshape(n, -1) - self.x.reshape(-1)) / self.sd

    def simulator(self) -> Any:
        """Return the simulator as a user would write it."""

        def fn(theta: Tensor, action: Tensor) -> Tensor:
            rows = theta.double().numpy(), action[:, 0].double().numpy()
            return torch.from_numpy(self.mean(*rows)).to(theta.dtype)

        if self.is_declared:
            return SimulatorModel(fn, noise=GaussianNoise(self.sd))

        def drawn(theta: Tensor, action: Tensor) -> Tensor:
            clean = fn(theta, action)
            return clean + self.sd * torch.randn_like(clean)

        return drawn
