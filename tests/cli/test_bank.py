import pytest
import torch

from sbi_active import Bank
from sbi_active.cli import main, simulators
from sbi_active.tasks import get_task

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
    monkeypatch.setattr(simulators, "BLOCK", 100)
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


def test_inspect_shows_what_a_bank_holds(robot, capsys):
    names = {k: f"{robot}:{k}" for k in ("simulator", "prior", "actions")}
    assert build("bank", 400, **names) == 0
    counts = Bank("bank").counts
    capsys.readouterr()
    assert main(["bank", "inspect", "bank"]) == 0
    printed = capsys.readouterr().out
    assert f"simulator: {robot}.simulator" in printed
    assert f"rows: {counts}; on disk: 0.0" in printed
    assert "checksums: ok" in printed
    assert "drawn from: prior" in printed
