import os
from pathlib import Path

import pytest
import torch

from sbi_active import Bank
from sbi_active.cli import bank as command
from sbi_active.cli import main
from sbi_active.tasks import get_task
from tests.simulation.bank.filled import remove

MODULE = """
import torch
from sbi.utils import BoxUniform
from sbi_active import DiscreteActions

prior = BoxUniform(torch.zeros(1), torch.ones(1))
actions = DiscreteActions(torch.tensor([[1.0, 10.0], [2.0, 20.0]]))


def simulator(theta, action, seeds):
    x = theta * action
    return torch.where(action[:, :1] > 1, x, torch.nan)
"""


@pytest.fixture
def robot(tmp_path, request):
    """Make a module of its own name for each test, in the current folder."""
    name = f"robot_{request.node.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    return name


def build(folder, rows, **options):
    named = [f"--{key}={value}" for key, value in options.items()]
    return main(["bank", "build", folder, "--rows", str(rows), *named])


def test_build_goes_on_to_the_rows_wanted(monkeypatch, capsys):
    monkeypatch.setattr(command, "BLOCK", 200)
    assert build("direct", 500, task="numerical", seed=3) == 0
    assert "direct: 500 rows, {'ok': 500" in capsys.readouterr().out
    for rows in (150, 330, 330, 500, 100):
        assert build("steps", rows, task="numerical", seed=3) == 0
    direct, steps = Bank("direct").read(), Bank("steps").read()
    assert len(steps) == 500
    assert torch.equal(direct.theta, steps.theta)
    assert torch.equal(direct.action, steps.action)
    assert torch.equal(direct.x, steps.x)
    assert len(direct.theta.unique(dim=0)) == 500
    assert set(direct.action[:, 0].tolist()) <= set(
        get_task("numerical").actions.values[:, 0].tolist()
    )
    assert build("other", 500, task="numerical", seed=4) == 0
    assert not torch.equal(Bank("other").read().theta, direct.theta)
    log_proposal = Bank("steps").columns("log_proposal")["log_proposal"]
    assert torch.allclose(log_proposal, torch.tensor(0.01).double().log())


def test_inspect_shows_outcomes_by_action(robot, capsys):
    names = {k: f"{robot}:{k}" for k in ("simulator", "prior", "actions")}
    assert build("bank", 400, **names) == 0
    action = Bank("bank").columns("action")["action"]
    counts = [int((action[:, 0] == a).sum()) for a in (1, 2)]
    capsys.readouterr()
    assert main(["bank", "inspect", "bank"]) == 0
    printed = capsys.readouterr().out
    assert f"simulator: {robot}.simulator" in printed
    assert "rows: 400; on disk: 0.0" in printed
    assert "checksums: ok" in printed
    assert "drawn from prior: 400" in printed
    lines = [line.split() for line in printed.splitlines()[-2:]]
    assert lines == [
        ["1,", "10", "0", str(counts[0]), "0"],
        ["2,", "20", str(counts[1]), "0", "0"],
    ]


def test_inspect_bins_actions_that_differ(monkeypatch, capsys):
    monkeypatch.setattr(command, "LINES", 5)
    assert build("bank", 300, task="numerical") == 0
    capsys.readouterr()
    assert main(["bank", "inspect", "bank"]) == 0
    lines = capsys.readouterr().out.splitlines()[-10:]
    assert lines[0].split()[:3] == ["-5", "to", "-4"]
    assert sum(int(line.split()[3]) for line in lines) == 300


def test_inspect_names_a_damaged_file(capsys):
    build("bank", 300, task="numerical")
    remove(Path("bank"), 1)
    path = Path("bank", "store.db")
    assert main(["bank", "inspect", "bank"]) == 1
    printed = capsys.readouterr().out
    assert "checksums: NOT ok" in printed
    assert str(path) in printed


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["--task", "oscillator", "--option", "variant=x"],
            "expected options of 'oscillator' among",
        ),
        (
            ["--simulator", "math:sin"],
            "expected --theta-low and --theta-high, or --prior",
        ),
        (
            ["--simulator", "math", "--prior", "a:b", "--actions", "a:b"],
            "expected MODULE:NAME; got 'math'",
        ),
        (
            ["--simulator", "no_such:f", "--prior", "a:b", "--actions", "a:b"],
            "got ModuleNotFoundError: No module named 'no_such'",
        ),
        (
            ["--simulator", "math:tau2", "--prior", "a:b", "--actions", "a:b"],
            "expected 'tau2' in module 'math'; got none; choose among acos",
        ),
    ],
)
def test_bad_arguments(arguments, text, capsys):
    assert main(["bank", "build", "bank", "--rows", "10", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_another_simulator_is_refused(robot, capsys):
    build("bank", 10, task="numerical")
    names = {k: f"{robot}:{k}" for k in ("simulator", "prior", "actions")}
    assert build("bank", 20, **names) == 2
    assert "expected the simulator of the bank bank; got another" in (
        capsys.readouterr().err
    )
    assert build("bank", 20, task="numerical", option="variant=sinh") == 2
    assert main(["bank", "inspect", "nowhere"]) == 2
    assert "got no nowhere/store.db" in capsys.readouterr().err


def test_workers_simulate_the_same_rows(tmp_path, capsys):
    names = {k: f"robot_at_work:{k}" for k in ("simulator", "prior", "actions")}
    (tmp_path / "robot_at_work.py").write_text(
        MODULE.replace(
            "    x =", "    open(f'pid-{os.getpid()}', 'w').close()\n    x ="
        )
        + "\nimport os\n"
    )
    assert build("here", 3_000, **names) == 0
    assert {f.name for f in tmp_path.glob("pid-*")} == {f"pid-{os.getpid()}"}
    assert build("there", 3_000, workers=2, **names) == 0
    assert len([*tmp_path.glob("pid-*")]) == 3
    x = []
    for folder in ("here", "there"):
        columns = Bank(folder).columns("index", "x")
        x.append(columns["x"][columns["index"].argsort()])  # in order of their ends
    assert torch.equal(*(rows.nan_to_num(-1.0) for rows in x))
