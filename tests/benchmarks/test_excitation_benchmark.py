"""Signals of the excitation benchmark, and its table."""

from importlib.util import find_spec

import pytest
import torch

if find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from benchmarks.robots.signals import FACTORS, largest


def test_largest_finds_the_edge_of_a_limit_and_drops_what_has_none():
    """The share permitted is below a number of each signal, its center."""
    edges = torch.tensor([5.0, 1.0, 0.1, 0.01])
    action = torch.tensor([[0.0, 2.0, float(e), 0.0, 1.0, 0.0] for e in edges])
    found = largest(action, lambda a: a[:, 1] <= a[:, 2])
    assert found[:, 2].tolist() == edges[:3].tolist()
    assert float(found[0, 1]) == 2.0
    for share, edge in zip(found[1:, 1], edges[1:], strict=False):
        assert FACTORS[1] * edge < share <= edge
