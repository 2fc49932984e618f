"""Problems by which a belief's flag is judged: two families, each of any size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.oracles.noise import Normal
from tests.oracles.problem import Problem, box
from tests.oracles.problems import compartments

Array = NDArray[Any]


def oscillations(theta: Array, action: Array) -> Array:
    r"""Return a sum of damped oscillations at sixteen times.

    .. math::
        x(t) = \sum_j A_j e^{-t c_j} \cos(2 \pi f_j t), \qquad
        A_j = 1 + \theta_{2j} / 2, \; c_j = e^{\theta_{2j + 1}} / 4, \;
        f_j = .2 (j + 1),

    where a last parameter without a partner is an offset.

    Args:
        theta: Shape (n, d), within [-1, 1].
        action: Factor of the times less one, shape (n, 1).
    """
    n, d = theta.shape
    time = (1 + action) * np.linspace(0.1, 3.0, 16)
    x = np.zeros((n, 16)) + (theta[:, -1:] if d % 2 else 0.0)
    for j in range(d // 2):
        size, decay = 1 + theta[:, [2 * j]] / 2, np.exp(theta[:, [2 * j + 1]]) / 4
        x += size * np.exp(-time * decay) * np.cos(0.4 * np.pi * (j + 1) * time)
    return x


FAMILIES = "compartments", "oscillations"


def problem(family: str, dim: int, seed: int) -> Problem:
    """Return four trials of a family at a truth that is drawn.

    Args:
        family: One of ``FAMILIES``.
        dim: Number of parameters.
        seed: Seed of the truth and of the noise.
    """
    own = replace(compartments(dim), times=None)
    if family == "oscillations":
        own = replace(
            own,
            space=box([-1] * dim, [1] * dim),
            mean=oscillations,
            error=Normal(0.05),
        )
    rng = np.random.default_rng([dim, seed, len(family)])
    own = replace(own, truth=rng.uniform(-0.8, 0.8, dim), seed=seed)
    rows = np.repeat(own.truth[None], len(own.action), 0)
    clean = own.mean(rows, own.action)
    return replace(own, given=clean + own.error.sample(clean.shape, rng))
