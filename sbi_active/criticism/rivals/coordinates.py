"""Coordinates in which a search has steps of unit size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.joint_prior import JointPrior
from sbi_active.inference.sampling.coordinates import near_ends
from sbi_active.seeding import forked_generators
from sbi_active.support import support_bounds, support_of

#: A positive number whose prior spans this ratio (5 % to 95 %) is searched in logs.
WIDE = 100.0


class SearchCoordinates:
    r"""Maps (theta, phi, nuisances) to u, and the prior to its density.

    .. math::
        u_j = (t_j(z_j) - a_j) / b_j, \qquad t_j = \log \text{ or identity},

    with a and b the mean and deviation of the prior's draws. Bounds stay bounds, and a
    force has one where beyond it it would feed energy without end.

    Args:
        prior: Prior of theta.
        effects: Effects of the rival, of scope "campaign".
        nuisances: Effects of scope "trial": one phi in each of the trials.
        num_trials: t.

    Attributes:
        dim: Number of coordinates.
        num_own: Number of those that are no nuisances.
        places: Places of each effect's phi among the coordinates, by name.
        low: Lower bounds in u, shape (dim,).
        high: Upper bounds in u, shape (dim,).
        center: Center of the Gaussian that stands for the prior in a search, shape
            (dim,).
        precision: Inverse variance, 0 between two bounds, shape (dim,).
    """

    def __init__(
        self,
        prior: Distribution,
        effects: Sequence[Effect],
        nuisances: Sequence[Effect],
        num_trials: int,
    ) -> None:
        self.joint = JointPrior(prior, effects)
        self.nuisances, self.num_trials = [*nuisances], num_trials
        self.num_own = sum(self.joint.sizes)
        self.places: dict[str, slice] = {}
        at = self.joint.theta_dim
        for effect, copies in self._parts():
            self.places[effect.name] = slice(at, at + copies * effect.phi_dim)
            at += copies * effect.phi_dim
        self.dim, z = at, self._for_units()
        low, high = self._bounds()
        q = np.quantile(z, [0.05, 0.95], axis=0)
        self.is_log = (low >= 0) & (q[1] > WIDE * q[0])
        t = self._forward(z)
        self.shift, self.scale = t.mean(0), np.maximum(t.std(0), 1e-300)
        with np.errstate(divide="ignore"):
            self.low, self.high = (
                (np.where(self.is_log, np.log(end.clip(0)), end) - self.shift)
                / self.scale
                for end in (low, high)
            )
        u = (t - self.shift) / self.scale
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        # A prior with one bound is taken for a half Gaussian from there.
        edge = np.where(below, self.low, np.where(above, self.high, 0.0))
        self.center = np.where(below == above, 0.0, edge)
        spread = np.maximum(((u - self.center) ** 2).mean(0), 1e-12)
        self.precision = np.where(below & above, 0.0, 1 / spread)

    def sample(self, num: int, *, seed: int) -> Array:
        """Return prior draws, shape (num, dim)."""
        return self.from_z(self._raw(num, seed=seed))

    def from_z(self, z: Array) -> Array:
        """Return u, shape (n, dim), of natural values."""
        return (self._forward(z) - self.shift) / self.scale

    def to_z(self, u: Array) -> Array:
        """Return natural values (theta, phi, nuisances), shape (n, dim)."""
        t = u * self.scale + self.shift
        return np.where(self.is_log, np.exp(np.where(self.is_log, t, 0.0)), t)

    def sides(self, u: Array) -> NDArray[np.int64]:
        """Return the bound at which each of the first coordinates lies, (k,).

        They lie at one if a twentieth of the draws is near it (:func:`.near_ends`).
        From a deviation of a fifth of the prior's range (of a uniform prior it is .29)
        trials leave a parameter open: it is near any bound now and then.

        Args:
            u: Draws of a posterior, shape (n, k).

        Returns:
            -1 for the lower one, 1 for the upper one, 0 for none.
        """
        low, high = self.low[: u.shape[1]], self.high[: u.shape[1]]
        bounded = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(bounded, low, 0.0), np.where(bounded, high, 1.0)
        place = (u - low) / (high - low)
        below, above = near_ends(place)
        is_there = np.maximum(below, above) > 0.05
        is_there &= bounded & (place.std(0) <= 0.2)
        return np.where(is_there, np.where(below > above, -1, 1), 0)

    def split(self, u: Array) -> tuple[Tensor, dict[str, Tensor]]:
        """Return theta and phi by effect, as the simulator takes them."""
        z = torch.from_numpy(self.to_z(u))
        phi = {name: z[:, at] for name, at in self.places.items()}
        for effect in self.nuisances:
            shape = len(z), self.num_trials, effect.phi_dim
            phi[effect.name] = phi[effect.name].reshape(shape)
        return z[:, : self.joint.theta_dim], phi

    def log_prob(self, u: Array) -> Array:
        """Return log prior densities with respect to u, shape (n,)."""
        inside = ((u >= self.low) & (u <= self.high)).all(1)
        density = np.full(len(u), -np.inf)
        if not inside.any():
            return density
        # A bound itself may round to beyond.
        u = np.clip(u[inside], self.low + 1e-6, self.high - 1e-6)
        z = torch.from_numpy(self.to_z(u))
        log_p = self.joint.log_prob(z[:, : self.num_own]).double()
        for effect in self.nuisances:
            phi = z[:, self.places[effect.name]].reshape(-1, effect.phi_dim)
            log_p = log_p + effect.log_prob(phi).reshape(len(z), -1).sum(-1)
        jacobian = np.log(self.scale).sum()
        jacobian = jacobian + (u * self.scale + self.shift)[:, self.is_log].sum(1)
        density[inside] = log_p.numpy() + jacobian
        return density

    def groups(self) -> list[Array]:
        """Return directions for finite differences, each of shape (dim,), 0 or 1.

        The nuisances of different trials change different numbers of x, so that one
        step serves them all.
        """
        entry, at = [np.arange(self.num_own)], self.num_own
        for effect in self.nuisances:
            entry.append(np.tile(np.arange(at, at + effect.phi_dim), self.num_trials))
            at += effect.phi_dim
        return [*(np.concatenate(entry) == np.arange(at)[:, None]).astype(float)]

    def trial_of(self) -> NDArray[np.int64]:
        """Return the trial that each coordinate belongs to, -1 for all, (dim,)."""
        trials = np.arange(self.num_trials)
        own = [np.repeat(trials, effect.phi_dim) for effect in self.nuisances]
        return np.concatenate([np.full(self.num_own, -1), *own])

    def _parts(self) -> list[tuple[Effect, int]]:
        """Return the effects in their order, with how many of each there are."""
        own = [(effect, 1) for effect in self.joint.effects]
        return own + [(effect, self.num_trials) for effect in self.nuisances]

    def _for_units(self) -> Array:
        """Return draws by which each part has the same units beside any others.

        A null, or an end of another search, is carried from one rival to the next.
        A thousand draws give a prior's mean and deviation to some 3 %.
        """
        num_draws = 1_000
        with forked_generators(0):
            parts = [self.joint.prior.sample(torch.Size([num_draws])).double()]
        for effect, copies in self._parts():
            with forked_generators(0, effect.name):
                parts.append(effect.sample(num_draws * copies).double())
        return torch.cat([part.reshape(num_draws, -1) for part in parts], -1).numpy()

    def _raw(self, num: int, *, seed: int) -> Array:
        with forked_generators(seed):
            parts = [self.joint.sample((num,)).double()]
            for effect in self.nuisances:
                parts.append(effect.sample(num * self.num_trials).reshape(num, -1))
        return torch.cat(parts, -1).numpy()

    def _forward(self, z: Array) -> Array:
        safe = np.where(self.is_log, np.maximum(z, 1e-300), 1.0)
        return np.where(self.is_log, np.log(safe), z)

    def _bounds(self) -> tuple[Array, Array]:
        joint = self.joint
        pairs = [support_bounds(support_of(joint.prior), joint.theta_dim)]
        for effect, copies in self._parts():
            low, high = support_bounds(support_of(effect.prior), effect.phi_dim)
            if effect.scope == "campaign":
                least, most = dissipative_bounds(effect)
                low, high = np.maximum(low, least), np.minimum(high, most)
            pairs.append((np.tile(low, copies), np.tile(high, copies)))
        low, high = np.concatenate(pairs, 1)
        return low, high


def dissipative_bounds(effect: Effect) -> tuple[Array, Array]:
    """Return between which phi a force dissipates, shapes (phi_dim,); else infinite.

    Args:
        effect: Effect. One that adds a generalized force has bounds, if its force grows
            faster than the speed and drives with one sign of phi.

    Example:
        >>> from torch.distributions import Normal
        >>> one = Effect(
        ...     "gain", hook="observation", prior=Normal(0.0, 1.0), null=0.0,
        ...     apply=lambda x, phi, action, context: (1 + phi) * x,
        ... )
        >>> dissipative_bounds(one)
        (array([-inf]), array([inf]))
    """
    dim = effect.phi_dim
    low, high = np.full(dim, -np.inf), np.full(dim, np.inf)
    force = getattr(effect.apply, "force", getattr(effect.apply, "key", None))
    if effect.hook != "dynamics" or not callable(force):
        return low, high
    null = effect.null_phi(1)
    for k in range(dim):
        for sign, bound in ((1.0, high), (-1.0, low)):
            phi = null.clone()
            phi[0, k] += sign
            if _runs_away(effect, phi):
                bound[k] = float(null[0, k])
    return low, high


def _runs_away(effect: Effect, phi: torch.Tensor) -> bool:
    """Return whether the force drives at high speeds, and ever more so.

    Speeds are far beyond any tried, and it outgrows damping in proportion to them.
    """
    rng, speeds = np.random.default_rng(0), (1e3, 1e4)
    num_states, num_dofs = shape = 8, 64
    ways = np.where(rng.random(shape) < 0.5, -1.0, 1.0)
    q = rng.uniform(-1, 1, shape)
    context = Context(index=torch.zeros(num_states, dtype=torch.float64))
    action = torch.zeros(num_states, 1, dtype=torch.float64)
    given = effect.apply({}, phi.expand(num_states, -1), action, context)
    sizes = []
    for speed in speeds:
        total = np.zeros(shape)
        with np.errstate(all="ignore"):
            for force, numbers in given.get("force", {}).items():
                total += force(q, speed * ways, 0.0, np.asarray(numbers))
        power = (total * ways).sum(1)
        if not (np.isfinite(power).all() and (power > 0).all()):
            return False
        sizes.append(np.abs(power).mean())
    growth = np.log(sizes[1] / sizes[0]) / np.log(speeds[1] / speeds[0])
    return bool(growth > 1.5)
