"""Draws of a linear model against what is known in closed form."""

import numpy as np
import pytest

from sbi_active.criticism.identification.posterior import Sampler, Unknowns
from sbi_active.criticism.linear.processes import Grams, Processes

WHITE = Processes(np.ones(1), np.zeros(1), np.full(1, np.inf), np.zeros(1, bool))


def linear(num=200, strength=0.0, seed=0):
    """Return white Gram matrices of a line and a doubtful parabola, of size one."""
    rng = np.random.default_rng(seed)
    t = np.linspace(-1, 1, num)
    jacobian = np.stack([np.ones(num), t, t**2 - 1 / 3], 1)
    r = rng.standard_normal(num) - strength * jacobian[:, 2]
    rows = np.concatenate([r[:, None], jacobian], 1)
    gram = (rows.T @ rows)[None, None]
    return Grams(gram, np.zeros((1, 1)), np.array([num])), r, jacobian


def unknowns(low=-np.inf, effect=(-1, -1, 0)):
    precision = np.where(np.array(effect) >= 0, 1.0, 0.0)
    return Unknowns(
        np.array([low, -np.inf, -np.inf]),
        np.full(3, np.inf),
        np.zeros(3),
        precision,
        np.array(effect),
    )


def draws(grams, own, size: float | None = 1.0, seed=0):
    rng = np.random.default_rng(seed)
    return Sampler(grams, WHITE, own, [size], rng).draws(60)


def test_without_doubt_it_is_least_squares():
    grams, r, jacobian = linear()
    found = draws(grams, unknowns(effect=(-1, -1, -1)))
    cov = np.linalg.inv(jacobian.T @ jacobian)
    assert found.u.mean(0) == pytest.approx(-cov @ jacobian.T @ r, abs=0.01)
    assert found.u.std(0) == pytest.approx(np.sqrt(np.diag(cov)), rel=0.05)


def test_presence_has_its_probability():
    """Against the evidence of both models, by the matrix of what is marginal."""
    for strength in (0.0, 0.25):
        grams, r, jacobian = linear(strength=strength)
        prior = np.array([1e6, 1e6, 1.0])  # nearly flat beside the doubtful one
        log_z = []
        for k in (2, 3):
            part = jacobian[:, :k]
            cov = np.eye(len(r)) + part @ np.diag(prior[:k]) @ part.T
            log_z.append(-0.5 * (r @ np.linalg.solve(cov, r)))
            log_z[-1] -= 0.5 * np.linalg.slogdet(cov)[1]
        expected = 1 / (1 + np.exp(log_z[0] - log_z[1]))
        found = draws(grams, unknowns())
        assert found.present.mean() == pytest.approx(expected, abs=0.04)
        absent = ~found.present[:, 0]
        assert (found.u[absent, 2] == 0).all()


def test_bounds_hold():
    grams, r, jacobian = linear()
    best = -(np.linalg.inv(jacobian.T @ jacobian) @ jacobian.T @ r)[0]
    sd = 1 / np.sqrt(len(r))
    low = best + sd  # an edge one deviation above the best
    found = draws(grams, unknowns(low=low, effect=(-1, -1, -1)))
    assert found.u[:, 0].min() >= low
    # Of a normal variable above one deviation.
    assert found.u[:, 0].mean() == pytest.approx(best + 1.5251 * sd, abs=0.1 * sd)
