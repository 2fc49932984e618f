r"""Forces whose sign would feed energy without bound.

A passive machine may have less friction than its simulator, but none of it grows faster
than the speed and pushes: :math:`\phi\, v |v|` with a positive :math:`\phi` outgrows
any damping, fits what was tried a little better, and diverges beyond.
"""

from __future__ import annotations

import numpy as np
import torch

from sbi_active.arrays import Array
from sbi_active.criticism.effects.effect import Context, Effect


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


def _runs_away(
    effect: Effect,
    phi: torch.Tensor,
    *,
    # Speeds far beyond any tried, and the exponent of the speed from which a force
    # outgrows damping in proportion to it.
    speeds: tuple[float, ...] = (1e3, 1e4),
    exponent: float = 1.5,
    # Degrees of freedom, and states, at which a force is asked.
    num_dofs: int = 64,
    num_states: int = 8,
) -> bool:
    """Return whether the force drives at high speeds, and ever more so."""
    rng = np.random.default_rng(0)
    shape = num_states, num_dofs
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
    return bool(growth > exponent)
