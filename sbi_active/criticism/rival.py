"""A rival: the simulator with some effects and a distribution of its errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.criticism.effects import Effect
from sbi_active.criticism.errors import ErrorModel, Whitener
from sbi_active.criticism.scales import SearchCoordinates
from sbi_active.criticism.trial_simulator import TrialSimulator

__all__ = ["Rival"]

Array = NDArray[Any]

#: Odds that a trial has no outcome where the simulator has one, or vice versa.
DISAGREEMENT = 0.02


class Rival:
    r"""A model of the trials, :math:`p(x | z)\, p(z)` with z = (theta, phi).

    Args:
        name: Of the rival.
        simulator: Of the trials, shared by all rivals.
        prior: Of theta.
        effects: Effects that this rival has.
        nuisances: Effects of scope "trial", which every rival has.
        error: Distribution of the residual.
        spread: Deviation of the prior predictive, shape (N,): the residual where the
            simulator gives no number.

    Attributes:
        coordinates: Of z.
    """

    def __init__(
        self,
        name: str,
        *,
        simulator: TrialSimulator,
        prior: Distribution,
        effects: Sequence[Effect],
        nuisances: Sequence[Effect] = (),
        error: ErrorModel,
        spread: Array,
    ) -> None:
        self.name, self.effects = name, (*effects,)
        self.simulator, self.error, self.spread = simulator, error, spread
        self.coordinates = SearchCoordinates(
            prior, effects, nuisances, len(simulator.trials)
        )
        self.has_noise_effect = any(e.hook == "noise" for e in effects)

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return self.coordinates.dim

    @property
    def theta_dim(self) -> int:
        """Number of coordinates of the simulator's own parameters."""
        phi = sum(place.stop - place.start for place in self.columns().values())
        return self.dim - phi

    def columns(self) -> dict[str, slice]:
        """Return where each effect's phi stands among the coordinates, by name."""
        sizes = [(e.name, e.phi_dim) for e in self.effects]
        num = self.coordinates.num_trials
        sizes += [(e.name, e.phi_dim * num) for e in self.coordinates.nuisances]
        at = self.dim - sum(size for _, size in sizes)
        found = {}
        for name, size in sizes:
            found[name] = slice(at, at + size)
            at += size
        return found

    @property
    def searched(self) -> NDArray[np.bool_]:
        """Coordinates that a least-squares search may move: not those of the noise."""
        joint = self.coordinates.joint
        own = [e.hook != "noise" for e in joint.effects]
        flags = np.repeat([True, *own], joint.sizes)
        return np.concatenate([flags, np.ones(self.dim - len(flags), bool)])

    def residual(self, u: Array) -> tuple[Array, Array, Array]:
        """Return residuals in units of the declared noise.

        Args:
            u: Shape (n, dim).

        Returns:
            Observation minus prediction divided by the effects' factor on the noise,
            shape (n, N); log of these factors, summed, shape (n,); log odds of which
            trials have an outcome, shape (n,), 0 where all agree.
        """
        theta, phi = self.coordinates.split(u)
        mean, sd, valid = self.simulator.predict(theta, phi)
        x = self.simulator.measurements.x
        residual = np.where(np.isfinite(mean), x - mean, self.spread)
        log_scale = np.zeros(len(u))
        scale = self.simulator.noise_scale(phi, len(u))
        if sd is not None:
            sd = np.where(np.isfinite(sd), sd, self.spread)
            scale = sd if scale is None else scale * sd
        if scale is not None:
            scale = np.maximum(scale, 1e-12)
            residual, log_scale = residual / scale, np.log(scale).sum(1)
        agree = valid == self.simulator.measurements.valid
        log_agree = np.where(agree, 0.0, np.log(DISAGREEMENT))
        return residual, log_scale, log_agree.sum(1)

    def log_likelihood(self, u: Array) -> Array:
        """Return log p(x | z), shape (n,)."""
        residual, log_scale, log_agree = self.residual(u)
        log_p = self.error.log_likelihood(residual) - log_scale + log_agree
        return np.where(np.isfinite(log_p), log_p, -np.inf)

    def log_prior(self, u: Array) -> Array:
        """Return log p(z) with respect to u, shape (n,)."""
        return self.coordinates.log_prob(u)

    def jacobian(self, u: Array, whiten: Whitener, step: float) -> tuple[Array, Array]:
        """Return whitened residuals and their derivatives by finite differences.

        Args:
            u: Shape (n, dim).
            whiten: Maps (..., N) to (..., N).
            step: In u.

        Returns:
            Shapes (n, N) and (n, N, dim).
        """
        c = self.coordinates
        groups = [g for g in c.groups() if self.searched[g > 0].any()]
        sign = np.where(u + step > c.high, -1.0, 1.0)
        stack = [u, *[u + step * sign * g for g in groups]]
        all_r = whiten(self.residual(np.concatenate(stack))[0])
        r = all_r.reshape(len(stack), *u.shape[:1], -1)
        trial_of, trial = c.trial_of(), self.simulator.measurements.trial
        jac = np.zeros((*r[0].shape, self.dim))
        for k, group in enumerate(groups):
            change = (r[k + 1] - r[0]) / step
            for j in np.flatnonzero(group):
                part = sign[:, j, None] * change
                mine = trial_of[j] < 0
                jac[:, :, j] = part if mine else part * (trial == trial_of[j])
        return r[0], jac
