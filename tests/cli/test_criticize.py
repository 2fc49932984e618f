"""From a file to a report, and campaigns that are driven by commands."""

import functools
import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import arviz as az
import pandas as pd
import pytest
import torch
from matplotlib import image

from sbi_active import criticism
from sbi_active.cli import main, problem
from sbi_active.tasks import get_task
from tests.cli.sled import SIZES, SMALL, read

ROBOT = """
import torch
from torch.distributions import Normal
from sbi_active.criticism import Effect

def distance(theta, action):
    return action**2 / (2 * 9.81 * theta)

effects = [
    Effect("drag", hook="observation", prior=Normal(0.0, 0.01), null=0.0,
           apply=lambda x, phi, action, context: x - phi * action**4)
]
"""
SPEEDS = [1.0, 2.5, 1.5, 3.0, 2.0, 1.25, 2.75, 0.75, 2.25, 1.75, 0.5]
OPTIONS = ["--theta-low=0.1", "--theta-high=1", "--noise", "0.005"]


def write(rows, header="action_speed,x_distance"):
    with open("trials.csv", "w") as file:
        file.write("\n".join([header, *rows]) + "\n")


def measure(drag=0.004, last=1.0):
    """Write trials of a robot with drag, three of them held out, the last in a unit."""
    gen = torch.Generator().manual_seed(0)
    rows = []
    for i, v in enumerate(SPEEDS):
        x = v**2 / (2 * 9.81 * 0.4) - drag * v**4
        x += 0.005 * float(torch.randn((), generator=gen))
        x *= last if i == len(SPEEDS) - 1 else 1.0
        rows.append(f"{v},{x:.4f},{'fit' if i < 8 else 'held out'}")
    write(rows, "action_speed,x_distance,role")


def run(*options):
    with open("my_robot.py", "w") as file:
        file.write(ROBOT)
    return main(["criticize", "trials.csv", *options])


def test_a_file_gives_a_report(capsys, monkeypatch):
    monkeypatch.setattr(problem, "generic_effects", lambda *_, **__: [])
    measure()
    assert run("--simulator", "my_robot:distance", *OPTIONS, "--out", "found") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Verdict: drag (P")
    assert "3 held-out trials" in printed
    assert "saved: found/report.html" in printed
    with open("found/report.txt") as file:
        assert file.read().strip() in printed


@pytest.fixture
def compared(monkeypatch):
    """What is compared, where it is not compared for real."""
    calls = []

    def close_loop(simulator, prior, trials, **options):
        own = {"simulator": simulator, "prior": prior, "trials": trials}
        calls.append(SimpleNamespace(**own, **options))
        return SimpleNamespace(to_dict=dict)

    compare = functools.wraps(criticism.close_loop)(close_loop)
    monkeypatch.setattr(criticism, "close_loop", compare)
    return calls


#: What lacks, and what is said of it.
INCOMPARABLE = [
    (["1,2", "2,3"], OPTIONS[:2], "at least 3 repeats of one action"),
    (["1,2", "2,3"], [*OPTIONS[:2], "--noise", "0"], "expected --noise > 0"),
    (["1,2", "2,3"], OPTIONS[2:], "expected --theta-low and --theta-high"),
]


@pytest.mark.parametrize(("rows", "options", "message"), INCOMPARABLE)
def test_what_cannot_be_compared(rows, options, message, capsys):
    write(rows)
    assert run("--simulator", "my_robot:distance", *options) == 2
    assert message in capsys.readouterr().err


MOTOR = """
import torch

def speed(theta, action, *, inputs, times, input_times):
    u, step = inputs["voltage"], float(input_times[1] - input_times[0])
    keep = torch.exp(-step / theta[:, 1])
    w, found = torch.zeros(len(theta)).to(theta), []
    for k in range(u.shape[1]):
        found.append(w)
        w = keep * w + (1 - keep) * theta[:, 0] * u[:, k]
    series = torch.stack(found, 1)
    return series.gather(1, (times / step).round().long())
"""


def test_inputs_stand_in_a_file_of_their_own(compared, capsys):
    each = [(trial, k) for trial in range(6) for k in range(100)]
    rows = [f"{trial},{20 * k},{(trial * k) % 7 - 3}" for trial, k in each]
    write(rows, "trial,time_ms,input_voltage[V]")
    Path("trials.csv").rename("inputs.csv")
    rows = [f"{trial},{k / 50},{trial + k / 50}" for trial, k in each if k % 5 == 0]
    write(rows, "trial,time,x_speed[rad/s]")
    Path("my_motor.py").write_text(MOTOR)
    command = ["criticize", "trials.csv", "--simulator", "my_motor.py:speed"]
    command += ["--theta-low=1,.1", "--theta-high=6,1", "--noise", "0.03"]
    command += ["--inputs", "inputs.csv", "--set", "thin=false", "--seed", "7"]
    assert main(command) == 0
    (given,) = compared
    assert given.trials.inputs["voltage"].shape == (6, 100)
    assert "dead zone" in {effect.name for effect in given.effects}
    assert (given.thin, given.seed) == (False, 7)


def test_a_folder_of_recordings_with_columns_of_other_names(compared):
    Path("my_robot.py").write_text(ROBOT)
    Path("pushes").mkdir()
    for k, role in enumerate(("fit", "fit", "held out")):
        rows = f"v,s,part\n{k + 1},{0.1 * k},{role}\n"
        Path(f"pushes/push {k}.csv").write_text(rows)
    words = ["criticize", "pushes", "--simulator", "my_robot.py:distance", *OPTIONS]
    for column in ("x=s", "action=v", "role=part"):
        words += ["--columns", column]
    assert main(words) == 0
    (given,) = compared
    assert given.trials.action[:, 0].tolist() == [1, 2, 3]
    assert given.trials.role == ["fit", "fit", "held out"]


def test_a_task_gives_its_simulator_and_prior(compared):
    write(["-4,1.5", "2,3", "0.5,-1"], "action_xi,x_y")
    assert main(["criticize", "trials.csv", "--task", "numerical"]) == 0
    (given,), task = compared, get_task("numerical")
    theta, action = task.prior.sample((3,)), given.trials.action
    assert torch.equal(given.prior.log_prob(theta), task.prior.log_prob(theta))
    models = given.simulator, task.simulator
    own, known = (model.mean(theta, action) for model in models)
    assert torch.equal(own, known)
    assert given.effects


# ``sbi-active gate``: a decision for a CI, by its exit status


def test_a_ci_reads_the_exit_status_and_the_reason(capsys):
    speeds = [2.5, 0.5, 3.0, 1.0, 2.0, 1.5, 2.75, 1.25]
    errors = [2, -3, 4, -6, 5, -1, 3, -4]  # mm
    rows = []
    for k, (v, e) in enumerate(zip(speeds, errors, strict=True)):
        distance = v**2 / (19.62 * 0.4) + e / 1e3
        rows.append(f"{v},{distance:.4f},{'held out' if k > 4 else 'fit'}")
    write(rows, "action_speed[m/s],x_distance[m],role")
    Path("sled.py").write_text(ROBOT[: ROBOT.index("effects")])
    command = ["gate", "trials.csv", "--simulator", "sled.py:distance", *OPTIONS]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["decision"] == "SHIP"
    assert found["details"]["before"] < 0.02
    assert main([*command, "--theta-high=0.3", "--json"]) == 12
    found = json.loads(capsys.readouterr().out)
    assert found["decision"] == "OUT_OF_PRIOR"
    assert abs(found["details"]["bounds"][0]["bound"] - 0.3) < 1e-6


# A campaign driven from the command line, as a robot's program would


def answer(capsys, *words):
    """Return what a command prints as JSON."""
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    return read(capsys.readouterr().out)


def test_asked_told_believed_and_exported(camp, capsys):
    named = ["--simulator", "sled.py:slide", "--noise", "0.02"]  # of a copy
    asked = answer(capsys, "ask", "camp", *named)
    assert asked["trial"] == 1
    assert asked["names"] == ["speed"]
    assert 0.5 <= asked["action"][0] <= 3
    assert answer(capsys, "ask", "camp")["action"] == asked["action"]
    before = answer(capsys, "status", "camp")["belief"]["parameters"]["theta_1"]["sd"]
    assert answer(capsys, "tell", "camp", "0.7")["x"] == [pytest.approx(0.7)]
    assert answer(capsys, "status", "camp")["not_in_belief"] == [1]
    after = answer(capsys, "update", "camp")
    assert after["not_in_belief"] == []
    assert after["belief"]["parameters"].keys() == {"theta_1", "theta_2"}
    assert after["belief"]["parameters"]["theta_1"]["sd"] < before
    assert main(["export", "camp", "--netcdf", "out.nc"]) == 0
    assert az.from_netcdf("out.nc")["posterior"]["theta"].shape == (4, 500, 2)


TAPE = """
from torch.distributions import Normal
from sbi_active.criticism import Effect

offset = Effect(
    "tape slipped",
    hook="observation",
    prior=Normal(0.0, 1.0),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi,
)
own = [offset]
"""
LINE = """
from tape import own as effects


def line(theta, action):
    return theta * action
"""


def test_a_missing_effect_is_found_and_adopted(
    capsys, monkeypatch, tmp_path, few_draws
):
    monkeypatch.setattr(problem, "generic_effects", lambda *_, **__: [])
    Path("line.py").write_text(LINE)
    Path("tape.py").write_text(TAPE)
    words = ["--simulator", "line.py:line", "--theta-low", "0", "--theta-high", "1"]
    assert main(["init", "camp", *words, "--actions", "1,2,3", *SMALL]) == 0
    for index, action in enumerate((1, 2, 3, 1)):
        x = f"{0.5 * action + 0.3 + 0.02 * (-1) ** index:.4f}"
        assert main(["tell", "camp", x, "--action", str(action)]) == 0
    assert main(["criticize", "camp"]) == 0
    shown = capsys.readouterr().out
    assert "Verdict: tape slipped" in shown
    assert "sbi-active adopt camp" in shown
    assert main(["adopt", "camp"]) == 0
    monkeypatch.chdir(tmp_path.parent)  # where line.py lies is remembered
    folder = str(tmp_path / "camp")
    assert main(["update", folder]) == 0
    belief = answer(capsys, "status", folder)["belief"]["parameters"]
    assert belief["theta_2"]["mean"] == pytest.approx(0.3, abs=0.06)
    assert main(["report", folder]) == 0
    page = (tmp_path / "camp" / "report.html").read_text()
    assert "tape slipped" in page
    assert "http" not in page.replace("http-equiv", "")


def test_the_next_command_can_be_pasted(camp, capsys):
    Path("camp").rename("the sled")
    assert main(["tell", "the sled", "0.7", "--action", "1"]) == 0
    assert "next: sbi-active ask 'the sled'" in capsys.readouterr().out


def test_python_has_the_command_line():
    command = [sys.executable, "-m", "sbi_active", "--version"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == version("sbi-active")


# A task's campaign


def test_run_writes_table_and_figure(capsys):
    words = ["run", "numerical", "--rounds", "2", "--out", "a"]
    words += [f"--set={size}" for size in (*SIZES, "num_samples=100")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "the truth: " in printed
    assert "a/loop.png" in printed
    assert len(pd.read_csv("a/trials.csv")) == 2
    assert "sbi-active ask a/campaign" in printed
    assert image.imread("a/loop.png").shape[1] == 1320  # of campaign.plot
