"""Small simulators, one for each defect, and clean ones; the command on two files."""

import sys

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.cli import main
from sbi_active.simulation import check_simulator

PRIOR = BoxUniform(torch.tensor([0.0, -1.0]), torch.ones(2))
ACTIONS = DiscreteActions([0.5, 1.0, 1.5, 2.0])


def check(simulator):
    return check_simulator(simulator, PRIOR, ACTIONS, num_rows=64)


def noisy(theta, action):
    return theta * action + torch.randn_like(theta)


def row(theta, action, rng):
    return theta * action + rng.normal(size=2)


def some_raise(theta, action, rng):
    if theta[0] > 0.8:
        raise FloatingPointError("unstable contact")
    return row(theta, action, rng)


def raises(theta, action):
    raise RuntimeError("no model file")


def flat(theta, action):
    x = noisy(theta, action)
    return x if len(x) > 1 else x[:, :1]


def mixed(theta, action, seeds):
    noise = torch.randn(len(theta), 2, generator=torch.Generator().manual_seed(1))
    return theta * action + noise


#: Simulators, and what is said of their seeds.
CLEAN = [
    (noisy, "seeds: no argument"),
    (SimulatorModel(row, batched=False), "seeds: one a row"),
]


@pytest.mark.parametrize(("simulator", "seeds"), CLEAN)
def test_a_clean_simulator_is_ready(simulator, seeds):
    report = check(simulator)
    assert report.is_ready
    assert not report.warnings
    assert "x: shape (n, 2)" in report.facts
    assert "rows: 64 ok, 0 invalid, 0 missing" in report.facts
    assert any(fact.startswith(seeds) for fact in report.facts)


#: Simulators, and their defect.
DEFECTS = [
    (lambda t, a: t * a, "got identical x from two seeds"),
    (lambda t, a: noisy(t, a)[:1], "one row a parameter set, shape (16, ...); got"),
    (raises, "RuntimeError: no model file"),
    (flat, "of one shape; got (2,) a row from 16 rows and (1,) from one"),
    (lambda t, a: torch.full_like(t, torch.nan), "no row has a measurement"),
    (mixed, "x depends on which rows are simulated together"),
    (lambda t, a: a + torch.randn_like(a), "no parameter changes x"),
]


@pytest.mark.parametrize(("simulator", "expected"), DEFECTS)
def test_defects_are_found(simulator, expected):
    report = check(simulator)
    assert str(report).endswith("\nnot ready")
    assert any(expected in defect for defect in report.defects)


#: Simulators, and what is said of them.
WARNED = [
    (lambda t, a: noisy(t, a)[:, :1], "changing theta_2 leaves x as it is"),
    (SimulatorModel(noisy, noise=1.0), "fn is random beside declared noise, which"),
    (SimulatorModel(some_raise, batched=False), "unstable contact; their outcome"),
]


@pytest.mark.parametrize(("simulator", "expected"), WARNED)
def test_warnings_do_not_fail(simulator, expected):
    report = check(simulator)
    assert report.is_ready
    assert any(expected in warning for warning in report.warnings)


#: Names of files, their noise, exit status, and what is said.
COMMANDS = [
    ("robot_a", "torch.randn_like(theta)", 0, "\nready\n"),
    ("robot_b", "0", 1, "defect: "),
    ("json", "0", 2, "expected a file whose name no other module has"),
]


@pytest.mark.parametrize(("name", "noise", "status", "text"), COMMANDS)
def test_the_command(tmp_path, capsys, monkeypatch, name, noise, status, text):
    monkeypatch.setattr(sys, "path", [*sys.path])
    lines = "import torch\n", "def fn(theta, action):\n", f"    return theta + {noise}"
    (tmp_path / f"{name}.py").write_text("".join(lines))
    words = ["--theta-low=0,-1", "--theta-high=1,1", "--actions", "0.5:2:4"]
    assert main(["check", f"{tmp_path}/{name}.py:fn", *words, "--rows=64"]) == status
    captured = capsys.readouterr()
    assert text in captured.err + captured.out
