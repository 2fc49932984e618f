"""A line with Gaussian noise and linear effects: all evidences are closed forms."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import torch
from scipy.stats import multivariate_normal
from torch.distributions import Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect, Trials
from sbi_active.criticism.linear.mixture import WIDTHS
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.verdict import Verdict, judge
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.simulation import NoiseModel
from tests.effects import added

ACTION = torch.linspace(-2, 2, 12)[:, None]
XI = ACTION[:, 0].double().numpy()
NOISE = 0.1
SENSOR = GaussianNoise(NOISE)
PRIOR = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
SHAPES = {
    "curve": lambda xi: xi**2 - 1,
    "wave": lambda xi: torch.sin(4 * xi),
    "kink": lambda xi: (xi > 0.5).to(xi),
}
FAMILIES = {"curve": "dynamics", "wave": "dynamics", "kink": "measurement"}


def effect(name: str) -> Effect:
    return added(name, SHAPES[name], family=FAMILIES[name])


def measured(*, seed: int = 0, further: torch.Tensor | float = 0.0, **phi: float):
    """Return outcomes of a line, effects of some sizes, and noise, shape (12, 1)."""
    noise = torch.randn(12, 1, generator=torch.Generator().manual_seed(seed))
    x = 0.3 + 0.8 * ACTION + NOISE * noise + further
    return x + sum((size * SHAPES[name](ACTION) for name, size in phi.items()), 0.0)


def rivals(
    x: torch.Tensor,
    *further: Effect,
    action: torch.Tensor = ACTION,
    noise: NoiseModel = SENSOR,
) -> RivalSet:
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] + theta[:, 1:] * action, noise=noise
    )
    effects = [*map(effect, SHAPES), *further]
    return RivalSet(model, PRIOR, Trials(action, x), effects)


def judged(some: RivalSet, groups: Sequence[frozenset[str]] = ()) -> Verdict:
    """Return the verdict of linear models, which in this world are exact."""
    return judge(linear_models(some)[0], groups)


def columns(names: tuple[str, ...]) -> np.ndarray:
    """Return what parameters and effects are multiplied by, shape (12, 2 + k)."""
    shapes = [SHAPES[name](ACTION)[:, 0].double().numpy() for name in names]
    return np.stack([XI**0, XI, *shapes], 1)


def log_evidence(x: torch.Tensor, names: tuple[str, ...] = ()) -> float:
    """Return the exact log evidence, effects with priors of unknown scale."""
    design, each = columns(names), []
    for scales in product(WIDTHS, repeat=len(names)):
        root = design * np.array([1.0, 1.0, *scales])
        covariance = root @ root.T + NOISE**2 * np.eye(12)
        normal = multivariate_normal(np.zeros(12), covariance)
        each.append(normal.logpdf(x[:, 0].double().numpy()))
    return float(np.logaddexp.reduce(each) - np.log(len(each)))


def posterior(
    x: torch.Tensor, names: tuple[str, ...], known: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of (theta, phi) under the declared priors."""
    design = columns(names)[known]
    precision = design.T @ design / NOISE**2 + np.eye(2 + len(names))
    covariance = np.linalg.inv(precision)
    mean = covariance @ design.T @ x[known, 0].double().numpy() / NOISE**2
    return mean, covariance
