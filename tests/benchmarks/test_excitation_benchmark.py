"""Signals of the excitation benchmark, and its table."""

from importlib.util import find_spec

import pytest
import torch

if find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from benchmarks.robots import excitation
from benchmarks.robots.excitation import (
    limits_of,
    permitted_pool,
    robot_of,
)
from benchmarks.robots.signals import FACTORS, SHARE, largest


def test_a_pool_keeps_the_limits_and_is_as_large_as_they_permit(monkeypatch):
    monkeypatch.setattr(excitation, "NUM_DRAWN", 6)
    robot = robot_of("arm", 2.0)
    limits = limits_of("arm", robot)
    pool = permitted_pool("arm", robot, None, seed=1)
    assert 50 <= len(pool) <= 58
    assert pool.shape[1] == 11
    assert {*pool[:, -1].tolist()} == {0.0, 1.0}
    assert limits(pool).all()
    larger = pool.clone()
    larger[:, 1::5] /= FACTORS[1]  # the next one
    open_ = (larger[:, 1::5] <= SHARE[1]).all(1)
    assert open_.any()
    assert not limits(larger)[open_].any()


def test_largest_finds_the_edge_of_a_limit_and_drops_what_has_none():
    """The share permitted is below a number of each signal, its center."""
    edges = torch.tensor([5.0, 1.0, 0.1, 0.01])
    action = torch.tensor([[0.0, 2.0, float(e), 0.0, 1.0, 0.0] for e in edges])
    found = largest(action, lambda a: a[:, 1] <= a[:, 2])
    assert found[:, 2].tolist() == edges[:3].tolist()
    assert float(found[0, 1]) == 2.0
    for share, edge in zip(found[1:, 1], edges[1:], strict=False):
        assert FACTORS[1] * edge < share <= edge
