"""The problems: each a function, with what makes it hard in one line.

Truths and seeds here judge engines; nothing may be tuned on them. Of the families,
compartments served to tune the flag of learned beliefs, with other truths; no other was
tuned on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from sbi.utils import MultipleIndependent
from torch.distributions import Bernoulli

from sbi_active.tasks import get_task
from tests.oracles.problem import Array, Normal, Problem, Student, Uniform, box, gauss

PROBLEMS: dict[str, Callable[[], Problem]] = {}


def problem(fn: Callable[..., Problem], *given: Any) -> Callable[..., Problem]:
    """Register a problem by the name of its function and what it is given."""
    name = "_".join([fn.__name__, *map(str, given)])
    PROBLEMS[name] = lru_cache(lambda: replace(fn(*given), name=name))
    return fn


def column(*values: float) -> Array:
    """Return actions of one number, shape (t, 1)."""
    return np.array(values, dtype=float)[:, None]


# -------------------------------------------------------------- with a closed form


def linear(dim: int, numbers: int) -> Problem:
    """Return a linear model with normal prior and errors."""
    rng = np.random.default_rng([dim, numbers])
    mix = rng.standard_normal((dim, numbers)) / np.sqrt(dim)
    space = gauss(dim)
    hard = "numbers of a trial, none left over" if numbers < dim else "a closed form"
    return Problem(
        hard=f"{dim} parameters, {numbers} {hard}",
        space=space,
        mean=partial(_linear_mean, mix),
        error=Normal(0.1),
        action=column(0.5, 1.0, 2.0),
        truth=rng.standard_normal(dim),
        seed=dim,
        closed_form=linear_answer,
    )


def _linear_mean(mix: Array, theta: Array, action: Array) -> Array:
    return action * (theta @ mix)


for dim, numbers in [(1, 1), (3, 10), (6, 40), (7, 40), (10, 4), (20, 4), (20, 200)]:
    problem(linear, dim, numbers)


def linear_answer(own: Problem) -> tuple[Array, Array, float]:
    """Return mean, covariance and log evidence of a linear problem."""
    theta = np.concatenate([np.zeros((1, own.dim)), np.eye(own.dim)])
    base, *columns = own.means(theta).reshape(own.dim + 1, -1)
    matrix = np.array(columns).T - base[:, None]
    sd = own.error.scale
    precision = np.eye(own.dim) + matrix.T @ matrix / sd**2
    cov = np.linalg.inv(precision)
    x = own.x.reshape(-1) - base
    mean = cov @ matrix.T @ x / sd**2
    log_det = np.linalg.slogdet(precision)[1] + 2 * len(x) * np.log(sd)
    square = x @ x / sd**2 - mean @ precision @ mean
    return mean, cov, -0.5 * (square + log_det + len(x) * np.log(2 * np.pi))


# ------------------------------------------------------------ tasks of the library


@problem
def numerical() -> Problem:
    """Return the paper's numerical model after three trials."""
    space = box([-5, -5], [5, 5])

    def mean(theta: Array, action: Array) -> Array:
        return theta[:, :1] * np.exp(3 - action) + theta[:, 1:] * action

    return Problem(
        hard="a posterior 10,000 times narrower than the prior along one parameter",
        space=space,
        mean=mean,
        error=Normal(1.0),
        action=column(-5.0, 5.0, 0.0),
        truth=np.array([-3.0, 1.0]),
    )


@problem
def oscillator() -> Problem:
    """Return the task of a driven oscillator after three trials."""
    task: Any = get_task("oscillator")
    space = box(task.prior.base_dist.low.tolist(), task.prior.base_dist.high.tolist())

    def mean(theta: Array, action: Array) -> Array:
        from sbi_active.tasks.oscillator import model

        rows = torch.from_numpy(theta), torch.from_numpy(action)
        return model.mean(*rows).numpy()

    return Problem(
        hard="several frequencies explain six saturated readings",
        space=space,
        mean=mean,
        error=Normal(0.05),
        action=np.array([[0.6, 3.0], [0.6, 9.0], [1.6, 5.0]]),
        truth=np.array([4.2, 0.15, 1.2, 0.1]),
        seed=1,
    )


# -------------------------------------------------------------- time and chemistry


def compartments(dim: int) -> Problem:
    r"""Return a chain of compartments that is dosed at four places.

    .. math::
        \dot y_i = k_{i - 1} y_{i - 1} - k_i y_i, \qquad k = 10^\theta.
    """
    space = box([-1] * dim, [1] * dim)
    seen = np.unique(np.rint(np.linspace(0, dim - 1, min(dim, 4))).astype(int))
    return Problem(
        hard=f"{dim} rates over two decades, some of them hardly seen",
        space=space,
        mean=partial(_compartments_mean, seen),
        error=Normal(0.02),
        action=column(0.0, 0.25, 0.5, 0.75),
        truth=np.random.default_rng(100 + dim).uniform(-0.8, 0.8, dim),
        seed=100 + dim,
        times=np.arange(1.0, 9.0),
    )


def _compartments_mean(seen: Array, theta: Array, action: Array) -> Array:
    rate = 10.0**theta
    n, d = rate.shape
    amount = np.zeros((n, d))
    amount[np.arange(n), np.minimum((action[:, 0] * d).astype(int), d - 1)] = 1.0

    def slope(y: Array) -> Array:
        flow = rate * y
        return np.concatenate([-flow[:, :1], flow[:, :-1] - flow[:, 1:]], 1)

    rows, step = [], 0.1  # Runge-Kutta of order four
    for k in range(80):
        a = slope(amount)
        b = slope(amount + step / 2 * a)
        c = slope(amount + step / 2 * b)
        e = slope(amount + step * c)
        amount = amount + step / 6 * (a + 2 * b + 2 * c + e)
        if k % 10 == 9:
            rows.append(amount[:, seen])
    return np.concatenate(rows, 1)


for dim in (3, 6, 10):
    problem(compartments, dim)


@problem
def decay() -> Problem:
    """Return a decay that is sampled 500 times a trial."""
    space, times = box([0.1, 0.2], [3.0, 3.0]), np.linspace(0.0, 4.0, 500)

    def mean(theta: Array, action: Array) -> Array:
        return action * theta[:, 1:] * np.exp(-theta[:, :1] * times)

    return Problem(
        hard="500 numbers a trial",
        space=space,
        mean=mean,
        error=Normal(0.2),
        action=column(0.5, 1.0),
        truth=np.array([0.9, 1.4]),
        seed=2,
        times=times,
    )


# -------------------------------------------------------------------------- shapes


@problem
def eight_modes() -> Problem:
    """Return squares of three parameters: eight modes of unequal weight."""
    space = gauss(3, center=0.15)

    def mean(theta: Array, action: Array) -> Array:
        return action * theta**2

    return Problem(
        hard="eight modes of weights .07 to .20, far apart",
        space=space,
        mean=mean,
        error=Normal(0.1),
        action=column(1.0, 2.0),
        truth=np.array([0.8, 1.1, 1.5]),
        seed=3,
        region=_signs,
    )


def _signs(theta: Array) -> Array:
    return (theta > 0) @ 2 ** np.arange(theta.shape[1])


@problem
def banana() -> Problem:
    """Return a curved ridge."""
    space = gauss(2)

    def mean(theta: Array, action: Array) -> Array:
        return action * (theta[:, 1:] + 1.5 * theta[:, :1] ** 2)

    def region(theta: Array) -> Array:
        """Return the side of the ridge, and whether it is beyond a deviation."""
        off = np.abs(mean(theta, np.ones((1, 1)))[:, 0] - 0.82) > 0.045
        return (theta[:, 0] > 0) + 2 * off

    return Problem(
        hard="a curved ridge, as long as the prior and .05 wide",
        space=space,
        mean=mean,
        error=Normal(0.1),
        action=column(1.0, 2.0),
        truth=np.array([0.4, 0.6]),
        seed=4,
        region=region,
    )


@problem
def jump() -> Problem:
    """Return an outcome that jumps where a threshold is passed."""
    space = box([0.0, 0.0], [1.0, 1.0])

    def mean(theta: Array, action: Array) -> Array:
        slips = action > 2 * theta[:, 1:]
        return action * theta[:, :1] + np.where(slips, 1.5, 0.0)

    return Problem(
        hard="jumps in a parameter that changes nothing else",
        space=space,
        mean=mean,
        error=Normal(0.1),
        action=column(0.3, 0.9, 1.4),
        truth=np.array([0.6, 0.55]),
        seed=5,
        is_smooth=False,
    )


@problem
def edge() -> Problem:
    """Return data that ask for a parameter beyond its prior's bound."""
    space = box([0.0, 0.0], [1.0, 1.0])

    def mean(theta: Array, action: Array) -> Array:
        return theta[:, :1] * action + theta[:, 1:] * action**2

    return Problem(
        hard="the mode at an edge of the prior",
        space=space,
        mean=mean,
        error=Normal(0.05),
        action=column(0.5, 1.0, 1.5),
        truth=np.array([1.05, 0.4]),
        seed=6,
    )


# ------------------------------------------------------------- errors and outcomes


def _line(theta: Array, action: Array) -> Array:
    return theta[:, :1] * action + theta[:, 1:] / action


def _lines(**changes: Any) -> Problem:
    space = box([-2.0, -2.0], [2.0, 2.0])
    own = Problem(
        hard="",
        space=space,
        mean=_line,
        error=Normal(0.1),
        action=column(0.5, 1.0, 1.5, 2.0),
        truth=np.array([0.7, -0.4]),
        seed=7,
    )
    return replace(own, **changes)


@problem
def hard_edged() -> Problem:
    """Return errors of a uniform distribution."""
    return _lines(hard="errors that end: a posterior with edges", error=Uniform(0.2))


@problem
def student() -> Problem:
    """Return Student errors of two and a half degrees of freedom."""
    return _lines(hard="errors of a heavy tail", error=Student(0.1, 2.5))


@problem
def missing() -> Problem:
    """Return trajectories some of whose numbers are lost."""
    times = np.linspace(0.2, 2.0, 10)

    def mean(theta: Array, action: Array) -> Array:
        return action * theta[:, :1] * np.sin(times * (2 + theta[:, 1:]))

    lost = ((0, 3), (0, 4), (1, 0), (2, 7), (2, 8), (2, 9))
    return _lines(
        hard="six numbers of forty are lost", mean=mean, lost=lost, times=times
    )


@problem
def invalid() -> Problem:
    """Return a trial without an outcome, which is known to come from large sums."""

    def mean(theta: Array, action: Array) -> Array:
        x = _line(theta, action)
        return np.where(x > 1.0, np.nan, x)

    return _lines(hard="a trial that failed says where the parameters are", mean=mean)


# ------------------------------------------------------------------------ discrete


class OnOrOff:
    """A friction, uniform, and a payload that is on or off with equal probability."""

    def __init__(self) -> None:
        self._friction = box([0.2], [1.0])
        parts = [self._friction.prior, Bernoulli(torch.tensor([0.5]))]
        self.prior: Any = MultipleIndependent(parts, validate_args=False)

    def __call__(self, u: Array) -> Array:
        """Return parameters (n, 2) of coordinates (n, 2)."""
        return np.concatenate([self._friction(u[:, :1]), u[:, 1:] > 0], 1)


@problem
def payload() -> Problem:
    """Return a friction and a payload that is on or off."""

    def mean(theta: Array, action: Array) -> Array:
        slide = action**2 / (2 * 9.81 * theta[:, :1])
        return slide * (1 + 0.3 * theta[:, 1:])

    return Problem(
        hard="one parameter takes two values",
        space=OnOrOff(),
        mean=mean,
        error=Normal(0.02),
        action=column(3.0),
        truth=np.array([0.55, 1.0]),
        seed=8,
        region=_is_on,
        is_smooth=False,
    )


def _is_on(theta: Array) -> Array:
    return (theta[:, 1] > 0.5).astype(int)
