"""A rival whose posterior is Gaussian, with its evidence and its moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import multivariate_normal
from torch.distributions import Independent, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival import Rival

DEVIATION = np.array([2.0, 1.0])
ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]


@dataclass(frozen=True)
class Exact:
    """The posterior of theta in natural values, and the evidence in nats."""

    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float


def linear_rival() -> Rival:
    """Return x = theta_1 + theta_2 xi + noise under independent normal priors."""
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] + theta[:, 1:] * action,
        noise=GaussianNoise(0.5),
    )
    prior = Independent(Normal(torch.zeros(2), torch.as_tensor(DEVIATION).float()), 1)
    actions = DiscreteActions(torch.linspace(-2, 2, 9))
    return RivalSet(model, prior, Trials(ACTION, X), [], actions=actions).rival(
        ModelKey()
    )


def exact() -> Exact:
    """Return the closed forms of :func:`linear_rival`."""
    xi = ACTION[:, 0].double().numpy()
    x = X[:, 0].double().numpy()
    design = np.stack([xi**0, xi], 1)
    covariance = np.linalg.inv(design.T @ design / 0.25 + np.diag(DEVIATION**-2))
    scaled = design * DEVIATION
    marginal = multivariate_normal(
        np.zeros(len(x)), scaled @ scaled.T + 0.25 * np.eye(len(x))
    )
    mean = covariance @ design.T @ x / 0.25
    return Exact(mean, covariance, float(marginal.logpdf(x)))
