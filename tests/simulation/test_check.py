"""The command on small modules in files, one for each defect, and a clean one."""

import sys

import pytest

from sbi_active.cli import main

HEAD = "import numpy as np\nimport torch\nfrom sbi_active import *\n"
SPACE = ["--theta-low=0,-1", "--theta-high=1,1", "--actions", "0.5:2:4"]

CLEAN = """
def simulator(theta, action):
    return theta[:, :1] * action + theta[:, 1:] + torch.randn(len(theta), 1)
"""
ROWS = """
def row(theta, action, rng):
    return theta * action + rng.normal(size=2)

simulator = SimulatorModel(row, batched=False)
"""
DETERMINISTIC = """
def simulator(theta, action):
    return theta * action
"""
ONE_ROW = """
def simulator(theta, action):
    return (theta * action + torch.randn_like(theta))[:1]
"""
RAISES = """
def simulator(theta, action):
    raise RuntimeError("no model file")
"""
FLAT = """
def simulator(theta, action):
    x = theta * action + torch.randn_like(theta)
    return x if len(x) > 1 else x[:, :1]
"""
NOTHING = """
def simulator(theta, action):
    return torch.full((len(theta), 2), torch.nan)
"""
MIXED = """
def simulator(theta, action, seeds):
    noise = torch.randn(len(theta), 2, generator=torch.Generator().manual_seed(1))
    return theta * action + noise
"""
NO_PARAMETER = """
def simulator(theta, action):
    return action + torch.randn_like(action)
"""
IDLE = """
def simulator(theta, action):
    return theta[:, :1] + torch.randn(len(theta), 1)
"""
TWICE = """
def fn(theta, action):
    return theta * action + torch.randn_like(theta)

simulator = SimulatorModel(fn, noise=GaussianNoise(1.0))
"""
SOME_RAISE = """
def row(theta, action, rng):
    if theta[0] > 0.8:
        raise FloatingPointError("unstable contact")
    return theta * action + rng.normal(size=2)

simulator = SimulatorModel(row, batched=False)
"""


@pytest.fixture(autouse=True)
def _same_path(monkeypatch):
    """Let no folder of a test stay on the path, which processes started later get."""
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture
def check(tmp_path, capsys, request, monkeypatch):
    """Return exit status and printed text of the command on a module of this text."""

    def run(text, *options):
        name = f"robot_{abs(hash(request.node.name))}"
        (tmp_path / f"{name}.py").write_text(HEAD + text)
        path = str(tmp_path / f"{name}.py:simulator")
        status = main(["check", path, *SPACE, "--rows", "64", *options])
        captured = capsys.readouterr()
        return status, captured.err + captured.out

    return run


@pytest.mark.parametrize("text", [CLEAN, ROWS], ids=["batch", "rows"])
def test_a_clean_simulator_is_ready(check, text):
    status, printed = check(text)
    assert status == 0
    assert printed.strip().endswith("\nready")
    assert "warning" not in printed
    assert "rows: 64 ok, 0 invalid, 0 missing" in printed
    if text is CLEAN:
        assert "x: shape (n, 1)\nseeds: no argument" in printed
    else:
        assert "x: shape (n, 2)\nseeds: one a row" in printed


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (DETERMINISTIC, "got identical x from two seeds"),
        (ONE_ROW, "x with one row a parameter set, shape (16, ...); got (1, 2)"),
        (RAISES, "RuntimeError: no model file"),
        (FLAT, "of one shape; got (2,) a row from 16 rows and (1,) from one"),
        (NOTHING, "no row has a measurement"),
        (MIXED, "x depends on which rows are simulated together"),
        (NO_PARAMETER, "no parameter changes x"),
    ],
)
def test_defects_are_found(check, text, expected):
    status, printed = check(text)
    assert status == 1
    assert printed.strip().endswith("\nnot ready")
    (line,) = [s for s in printed.splitlines() if expected in s]
    assert line.startswith("defect: ")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (IDLE, "changing theta_2 leaves x as it is"),
        (TWICE, "fn is random beside declared noise, which so counts twice"),
        (SOME_RAISE, "FloatingPointError: unstable contact; their outcome is missing"),
    ],
)
def test_warnings_do_not_fail(check, text, expected):
    status, printed = check(text)
    assert status == 0
    (line,) = [s for s in printed.splitlines() if expected in s]
    assert line.startswith("warning: ")


def test_files_named_like_other_modules_are_refused(tmp_path, capsys):
    (tmp_path / "json.py").write_text(HEAD + CLEAN)
    assert main(["check", f"{tmp_path}/json.py:simulator", *SPACE]) == 2
    assert "expected a file whose name no other module has" in capsys.readouterr().err
