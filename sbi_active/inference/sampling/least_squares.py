"""Levenberg-Marquardt from many starts at once, within bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array

#: Maps residuals (..., N) to (..., N) of unit variance.
Whitener = Callable[[Array], Array]


class Bounds(Protocol):
    """Coordinates of a search: bounds and a Gaussian that stands for the prior."""

    low: Array
    high: Array
    center: Array
    precision: Array


class LeastSquares(Protocol):
    """A sum of squares and its derivatives."""

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def coordinates(self) -> Bounds:
        """Coordinates of the search."""
        ...

    @property
    def searched(self) -> NDArray[np.bool_]:
        """Coordinates that may be moved, shape (dim,)."""
        ...

    def residual(self, u: Array) -> tuple[Array, ...]:
        """Return residuals of (n, dim), first of the tuple, shape (n, N)."""
        ...

    def jacobian(
        self, u: Array, whiten: Whitener, step: float | Array
    ) -> tuple[Array, Array]:
        """Return whitened residuals and derivatives, (n, N) and (n, N, dim)."""
        ...


def floored(problem: LeastSquares, *, flat: float = 0.3) -> Array:
    """Return the prior's precision, shape (dim,), a wide one between two bounds."""
    return np.maximum(problem.coordinates.precision, flat)


def descend(
    problem: LeastSquares,
    u: Array,
    whiten: Whitener,
    step: float,
    iterations: int,
    *,
    free: NDArray[np.bool_] | None = None,
    center: Array | None = None,
    secant: bool = False,
    known: tuple[Array, Array] | None = None,
    converged: float = 0.02,
) -> tuple[Array, Array]:
    """Return improved starts and their cost, shapes (n, dim) and (n,).

    Args:
        problem: The model.
        u: Starts, shape (n, dim).
        whiten: Whitener of the residuals.
        step: Step of finite differences.
        iterations: Number of iterations at most; a start that is expected to gain
            nothing stops.
        free: Coordinates that are moved, shape (dim,); None takes those that may be.
        center: Center of the penalty, shape (n, dim); None has that of the prior.
        secant: Derivatives are updated from the steps made, by Broyden's rule, and not
            computed again.
        known: Whitened residuals at the starts and their derivatives, shapes (n, N) and
            (n, N, dim), where they need no simulation.
        converged: Expected fall of the sum of squares that is worth no further
            iteration.
    """
    c, dim = problem.coordinates, problem.dim
    weight = c.precision if center is None else floored(problem)
    center = np.broadcast_to(c.center if center is None else center, u.shape)
    free = problem.searched if free is None else free
    damping = np.full(len(u), 1e-2)
    u = u.copy()

    def penalized(r: Array, at: Array, rows: Array) -> Array:
        return (r**2).sum(1) + ((at - center[rows]) ** 2 * weight).sum(1)

    if known is None:
        known = problem.jacobian(u, whiten, step)
    r, jac = (part.copy() for part in known)
    cost = penalized(r, u, np.arange(len(u)))
    rows = np.arange(len(u))
    for i in range(iterations):
        part = jac[rows] * free  # what is held is known
        normal = np.einsum("nij,nik->njk", part, part) + np.diag(weight)
        gradient = np.einsum("nij,ni->nj", part, r[rows])
        gradient = gradient + (u[rows] - center[rows]) * weight
        diagonal = np.einsum("njj->nj", normal)
        lift = damping[rows, None] * diagonal + 1e-8
        system = normal + lift[:, :, None] * np.eye(dim)
        move = within(system, gradient, u[rows], c.low, c.high)
        new = np.clip(u[rows] - np.where(free, move, 0.0), c.low, c.high)
        linear = np.einsum("nij,nj->ni", part, new - u[rows])
        expected = cost[rows] - penalized(r[rows] + linear, new, rows)
        worth = expected > converged
        rows, new, linear = rows[worth], new[worth], linear[worth]
        if not len(rows):
            break
        new_r = whiten(problem.residual(new)[0])
        new_cost = penalized(new_r, new, rows)
        if secant:
            change = new - u[rows]
            miss = new_r - r[rows] - linear
            length = np.maximum((change**2).sum(1), 1e-300)[:, None, None]
            jac[rows] += miss[:, :, None] * change[:, None] / length
        better = new_cost < cost[rows]
        won = rows[better]
        u[won], cost[won], r[won] = new[better], new_cost[better], new_r[better]
        if len(won) and not secant and i < iterations - 1:
            _, jac[won] = problem.jacobian(u[won], whiten, step)
        damping[rows] = damping[rows] * np.where(better, 0.15, 10.0)
    return u, cost


def within(
    system: Array, gradient: Array, u: Array, low: Array, high: Array, *, most: int = 20
) -> Array:
    """Return the steps of normal equations, (n, dim), within bounds.

    A coordinate that a step would take beyond its bound is held there, and the others
    are found again: clipped alone, it would leave them where they are right only with
    it.

    Args:
        system: Matrices of the normal equations, shape (n, dim, dim).
        gradient: Gradients, shape (n, dim).
        u: Coordinates, shape (n, dim); a step is subtracted.
        low: Lower bounds, shape (dim,).
        high: Upper bounds.
        most: Number of times at most that coordinates are held at their bounds, or let
            go.

    References:
        Bertsekas, SIAM Journal on Control and Optimization 20 (1982).
    """
    move = np.linalg.solve(system, gradient[..., None])[..., 0]
    new = u - move
    for i in np.flatnonzero(((new < low) | (new > high)).any(1)):
        side = np.zeros(u.shape[1])  # 1 held at its lower bound, -1 at its upper one
        for _ in range(most):
            new = u[i] - move[i]
            out = (side == 0) * ((new < low).astype(float) - (new > high))
            # What is held, and would now be better off inside.
            pull = side * (gradient[i] - system[i] @ move[i])
            if not out.any() and not (pull < 0).any():
                break
            if out.any():
                side = side + out
            else:
                side[np.argmin(pull)] = 0.0
            held = side != 0
            move[i, held] = (u[i] - np.where(side > 0, low, high))[held]
            rest = gradient[i, ~held] - system[i][np.ix_(~held, held)] @ move[i, held]
            open_ = np.ix_(~held, ~held)
            move[i, ~held] = np.linalg.solve(system[i][open_], rest)
    return move


def basis_of(jacobian: Array) -> Array:
    """Return orthonormal columns that span those of (N, d), without flat directions."""
    basis, size, _ = np.linalg.svd(jacobian, full_matrices=False)
    return basis[:, size > 1e-9 * max(size.max(initial=0.0), 1e-300)]
