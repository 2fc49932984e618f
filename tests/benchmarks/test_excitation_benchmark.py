"""Signals of the excitation benchmark, and its table."""

import json
from importlib.util import find_spec

import pytest
import torch

if find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from benchmarks.robots import excitation
from benchmarks.robots.excitation import (
    MACHINES,
    limits_of,
    permitted_pool,
    robot_of,
    summary,
)
from benchmarks.robots.signals import FACTORS, SHARE, Played, largest


def test_goals_begin_at_rest_and_stay_within_their_share_of_the_reach():
    machine = MACHINES["arm"]
    played = Played(machine.drives, machine.center, machine.reach)
    torch.manual_seed(0)
    action = torch.rand(50, len(played.names))
    action[:, 2::5] = 2 * action[:, 2::5] - 1
    goals = played(action, torch.linspace(0, 8, 1601))
    for drive, center, reach in zip(
        machine.drives, machine.center, machine.reach, strict=True
    ):
        assert (goals[drive][:, 0] == center).all()
        # Four tones together may pass a fifth beyond what they rarely reach.
        assert ((goals[drive] - center).abs() <= 1.7 * reach).all()
    chirp = torch.tensor([[0.0, 1.0, 0.0, 0.0, 1.0] * 2])
    sweep = played(chirp, torch.linspace(0, 20, 4001))["shoulder servo"][0]
    assert float(sweep.abs().max()) == pytest.approx(0.8, rel=1e-3)
    turns = int((sweep[1:] * sweep[:-1] < 0).sum())
    assert turns == pytest.approx(2 * 20 * (0.1 + 10) / 2, abs=2)


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


def test_softer_drives_sag_four_times_as_far():
    robot = robot_of("arm", 2.0)
    still = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0] * 2])
    action = torch.cat([still.repeat(2, 1), torch.tensor([[0.0], [1.0]])], 1)
    theta = torch.tensor([[1.0, 0.05, 0.0, 1.0, 0.05, 0.0, 0.5]]).repeat(2, 1)
    stiff, soft = robot.simulator.mean(theta, action)[:, -1].double()
    # The arm is level where it does not sag; soft, gravity pulls it a little less.
    assert ((soft / stiff > 3.5) & (soft / stiff <= 4.0)).all()


def test_the_table_compares_with_the_chirps_of_the_same_case():
    def row(case, arm, seconds, sds, covered):
        return {
            "machine": "arm",
            "case": str(case),
            "arm": arm,
            "seconds": str(seconds),
            "sds": json.dumps(sds),
            "covered": str(covered),
            "cpu_seconds": "2",
        }

    rows = [
        row(0, "chirps", 60, [1.0, 2.0], 2),
        row(0, "chosen", 24.75, [0.5, 1.0], 2),
        row(1, "chirps", 60, [2.0, 2.0], 2),
        row(1, "chosen", 24.75, [1.0, 3.0], 1),
    ]
    _, _, _, chosen = summary(rows)
    assert chosen == "| arm | 2 | chosen | 24.75 | 0.50, 1.50 | 3 of 4 | 3 of 4 | 2 |"
