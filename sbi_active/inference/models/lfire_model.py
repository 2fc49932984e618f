"""Log ratios of a set of particles, by a logistic regression each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.particles import ParticleDraws
from sbi_active.inference.models.lfire import LFIRE, LogRatio
from sbi_active.inference.rounds.rows import RoundRows


@dataclass(frozen=True)
class LFIREModel:
    r"""Log ratios of particles at the actions that were simulated.

    Attributes:
        settings: Settings of the regressions.
        particles: Parameter sets, shape (p, theta_dim).
        action: Actions, shape (a, action_dim).
        center: Center of the outcomes of each action, shape (a, x_dim).
        scale: Scale of the outcomes of each action, shape (a, x_dim).
        log_ratios: A row an action, an entry a particle.
    """

    settings: LFIRE
    particles: Tensor
    action: Tensor
    center: Tensor
    scale: Tensor
    log_ratios: Sequence[Sequence[LogRatio]]

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
            ratios = self.log_ratios[a]
            own = particle[rows]
            weight = np.stack([r.weight for r in ratios])[own]
            intercept = np.array([r.intercept for r in ratios])[own]
            total[rows] = torch.from_numpy((psi.numpy() * weight).sum(1) + intercept)
        return total

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the simulated action next to one, shape (action_dim,)."""
        scale = self.action.std(0, correction=0).clamp_min(1e-12)
        gap = ((self.action - action) / scale).square().sum(1)
        return self.action[int(gap.argmin())]


def fit_log_ratios(
    settings: LFIRE, parts: Sequence[RoundRows], seed: int
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
    centers, scales, log_ratios = [], [], []
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
        log_ratios.append(
            [
                settings.fit(
                    psi[own == i],
                    psi[rng.permutation(len(psi))[: settings.num_marginal]],
                    int(rng.integers(2**31)),
                )
                for i in range(len(particles))
            ]
        )
    return LFIREModel(
        settings,
        particles,
        actions,
        torch.stack(centers),
        torch.stack(scales),
        log_ratios,
    )


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
