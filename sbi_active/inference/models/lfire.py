"""Likelihood-free inference by ratio estimation: a logistic regression a parameter."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from attrs import field, frozen
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegressionCV
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import at_least, require, suggests
from sbi_active.inference.beliefs.belief import ParticleDraws
from sbi_active.simulation.outcomes import Simulations


@suggests
@frozen(kw_only=True, slots=False)
class LFIRE:
    r"""Settings of a penalized logistic regression a parameter set.

    .. math::
        \log \frac{p(x | \theta, \xi)}{p(x | \xi)} \approx
        \beta_\theta^\top \psi(x) + \beta_{\theta, 0}

    separates outcomes at :math:`\theta` from outcomes of the marginal, both kinds
    weighing alike; :math:`\psi` is each number and its square, and a ridge penalty is
    chosen by cross-validated log loss.

    Attributes:
        num_marginal: Rows of the marginal in one regression, at most.

    References:
        Thomas, Dutta, Corander, Kaski & Gutmann, Bayesian Analysis 2022, who take a
        lasso penalty; on two or three summaries a ridge differs little and costs a
        tenth.
    """

    num_marginal: int = field(default=500, validator=at_least(10))
    #: Parts of the cross-validation.
    num_folds: ClassVar[int] = 3

    def summaries(self, x: Tensor, center: Tensor, scale: Tensor) -> Tensor:
        """Return summaries, and whether there was a measurement, shape (n, q + 1).

        Args:
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            center: Subtracted from the numbers before squares are taken, (x_dim,).
            scale: Scale by which they are divided, shape (x_dim,).
        """
        flat = x.double().flatten(1)
        valid = flat.isfinite().all(1, keepdim=True)
        z = (flat - center) / scale
        psi = torch.cat([z, z**2], 1)
        return torch.cat([torch.where(valid, psi, 0.0), valid.double()], 1)

    def fit(
        self,
        own: NDArray[np.float64],
        marginal: NDArray[np.float64],
        seed: int,
        *,
        fewest_rows: int = 2,
    ) -> NDArray[np.float64]:
        r"""Return :math:`\beta` and, last, :math:`\beta_0` at a parameter set, (q + 1).

        Args:
            own: Summaries of its outcomes, shape (n, q).
            marginal: Summaries of outcomes of the belief, shape (m, q).
            seed: Seed of the folds.
            fewest_rows: Rows of each kind a fold at least.
        """
        fewest = fewest_rows * self.num_folds
        require(
            min(len(own), len(marginal)) >= fewest,
            f"at least {fewest} outcomes of a parameter set and of the marginal",
            f"{len(own)} and {len(marginal)}",
            "simulate each parameter set several times, as SeqBED_LFIRE.arrange() does",
        )
        features = np.concatenate([own, marginal])
        label = np.repeat([1, 0], [len(own), len(marginal)])
        order = np.random.default_rng(seed).permutation(len(label))
        model = LogisticRegressionCV(
            Cs=np.logspace(-1, 4, 4),  # pyright: ignore
            cv=self.num_folds,
            scoring="neg_log_loss",
            solver="newton-cholesky",
            class_weight="balanced",
        )
        with warnings.catch_warnings():  # of arguments whose defaults will change
            warnings.simplefilter("ignore")
            model.fit(features[order], label[order])
        return np.append(model.coef_[0], model.intercept_[0])


@dataclass(frozen=True)
class LFIREModel:
    r"""Log ratios of particles at the actions that were simulated.

    Attributes:
        settings: Settings of the regressions.
        particles: Parameter sets, shape (p, theta_dim).
        action: Actions, shape (a, action_dim).
        center: Center of the outcomes of each action, shape (a, x_dim).
        scale: Scale of the outcomes of each action, shape (a, x_dim).
        weight: Weights of the summaries and, last, intercepts, (a, p, q + 1).
    """

    settings: LFIRE
    particles: Tensor
    action: Tensor
    center: Tensor
    scale: Tensor
    weight: NDArray[np.float64]

    @property
    def belief(self) -> Distribution:
        """The particles, each as likely: the only parameters it can say of."""
        return ParticleDraws(self.particles)

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log p(x_i | \theta_i, \xi_i) / p(x_i | \xi_i)`, float64 (n,).

        Args:
            theta: Particles, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            action: Simulated actions, shape (n, action_dim).
        """
        particle = _places(theta, self.particles, "theta", "particles")
        place = _places(action, self.action, "action", "simulated actions")
        total = torch.empty(len(theta), dtype=torch.float64)
        for a in place.unique().tolist():
            rows = torch.nonzero(place == a)[:, 0]
            psi = self.settings.summaries(x[rows], self.center[a], self.scale[a])
            own = self.weight[a][particle[rows]]
            log_ratio = (psi.numpy() * own[:, :-1]).sum(1) + own[:, -1]
            total[rows] = torch.from_numpy(log_ratio)
        return total

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the simulated action next to one, shape (action_dim,)."""
        scale = self.action.std(0, correction=0).clamp_min(1e-12)
        gap = ((self.action - action) / scale).square().sum(1)
        return self.action[int(gap.argmin())]


def fit_log_ratios(
    settings: LFIRE, parts: Sequence[Simulations], seed: int
) -> LFIREModel:
    """Fit the log ratio of every particle at every action.

    Each particle occurs several times at each action in the rows of all parts together;
    the seed is that of folds and of the marginal's rows.
    """
    theta = torch.cat([part.theta for part in parts])
    x = torch.cat([part.x for part in parts])
    action = torch.cat([part.action for part in parts])
    particles, particle = theta.unique(dim=0, return_inverse=True)
    actions, place = action.unique(dim=0, return_inverse=True)
    rng = np.random.default_rng(seed)
    centers, scales, weights = [], [], []
    for a in range(len(actions)):
        rows = torch.nonzero(place == a)[:, 0]
        flat = x[rows].double().flatten(1)
        known = flat[flat.isfinite().all(1)]
        center = known.mean(0) if len(known) else flat.new_zeros(flat.shape[1])
        scale = known.std(0, correction=0) if len(known) else torch.ones_like(center)
        scale = torch.where(scale > 0, scale, 1.0)
        psi = settings.summaries(x[rows], center, scale).numpy()
        centers.append(center)
        scales.append(scale)
        own = particle[rows].numpy()
        for i in range(len(particles)):
            marginal = psi[rng.permutation(len(psi))[: settings.num_marginal]]
            seed = int(rng.integers(2**31))
            weights.append(settings.fit(psi[own == i], marginal, seed))
    scaling = torch.stack(centers), torch.stack(scales)
    weight = np.stack(weights).reshape(len(actions), len(particles), -1)
    return LFIREModel(settings, particles, actions, *scaling, weight)


def _places(rows: Tensor, known: Tensor, name: str, what: str) -> Tensor:
    """Return the place of each row among those known, shape (n,)."""
    rows = torch.as_tensor(rows, dtype=torch.float32)
    rows, inverse = rows.unique(dim=0, return_inverse=True)
    same = (rows[:, None] == known).all(-1)
    found = same.any(1)
    if not bool(found.all()):
        other = rows[~found][0].tolist()
        raise ValueError(
            f"expected {name} among the {len(known)} {what} of this round; got "
            f"{other}; draw from model.belief and keep to the actions simulated"
        )
    return same.int().argmax(1)[inverse]
