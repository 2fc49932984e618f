"""``sbi-active criticize``: from a file to a report."""

import functools
import sys
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import torch

from sbi_active import criticism
from sbi_active.cli import main
from sbi_active.tasks import get_task

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


def test_a_file_gives_a_report(capsys):
    measure()
    assert run("--simulator", "my_robot:distance", *OPTIONS, "--out", "found") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Verdict: drag (P")
    assert "3 held-out trials" in printed
    assert "saved: found/report.html" in printed
    with open("found/report.txt") as file:
        assert file.read().strip() in printed


SLIDE = """
import torch
from torch.distributions import HalfNormal
from sbi_active.criticism import Effect

def place(theta, action, *, times, drag=None):
    loss = 9.81 * theta
    if drag is None:
        s = torch.minimum(times, action / loss)
        return action * s - loss * s**2 / 2
    loss, k = loss.double(), drag * torch.ones_like(action).double()
    root, edge = (loss * k).sqrt(), (action * (k / loss).sqrt()).atan()
    s = torch.minimum(times, edge / root)
    return ((edge - root * s).cos() / edge.cos()).log() / k

effects = [
    Effect("drag", hook="dynamics", prior=HalfNormal(0.3), null=0.0, units="1/m",
           apply=lambda value, phi, action, context: {
               **value, "drag": phi.clamp(min=1e-6)})
]
"""


def film(module="my_slide"):
    """Write a film of a block with drag, one row a sample, at uneven times."""
    space: dict = {}
    exec(SLIDE, space)
    gen = torch.Generator().manual_seed(0)
    rows = []
    for i, v in enumerate([1.0, 2.5, 1.5, 3.0, 2.0, 1.25, 2.75]):
        times = (torch.arange(6 + i % 2) / 10 + 0.05)[None].double()
        at = [torch.tensor([[value]]).double() for value in (0.4, v)]
        x = space["place"](*at, times=times, drag=0.3)[0]
        x = x + 0.003 * torch.randn(len(x), generator=gen)
        role = "fit" if i < 5 else "held out"
        for t, value in zip(times[0].tolist(), x.tolist(), strict=True):
            rows.append(f"p{i},{1000 * t:.0f},{v},{value:.4f},{role}")
    write(rows, "push,time_ms,action_speed[m/s],x_place[m],role")
    with open(f"{module}.py", "w") as file:
        file.write(SLIDE)


@pytest.fixture
def compared(monkeypatch):
    """What is compared, where it is not compared for real."""
    calls = []

    def close_loop(simulator, prior, trials, **options):
        calls.append(SimpleNamespace(simulator=simulator, trials=trials, **options))
        return SimpleNamespace(to_dict=dict)

    compare = functools.wraps(criticism.close_loop)(close_loop)
    monkeypatch.setattr(criticism, "close_loop", compare)
    return calls


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        (["1,2"], OPTIONS, "at least two valid trials to fit; got 1"),
        (["1,2", "2,3"], OPTIONS[:2], "at least 3 repeats of one action"),
        (["1,2", "2,3"], [*OPTIONS[:2], "--noise", "0"], "expected --noise > 0"),
        (["1,2", "2,3"], OPTIONS[2:], "expected --theta-low and --theta-high"),
    ],
)
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


def folder_of_films(folder="films"):
    """Write one file a push, and the simulator beside them."""
    Path(folder).mkdir()
    sys.modules.pop("my_swing", None)  # of another test
    film(f"{folder}/my_swing")
    table = pd.read_csv("trials.csv")
    for i, push in enumerate(table["push"].unique()):
        rows = table[table["push"] == push].drop(columns="push")
        rows["role"] = "held out" if i == 2 else "fit"
        rows.to_csv(f"{folder}/push {i + 1}.csv", index=False)
    Path("trials.csv").rename("all.csv")
    return Path(folder), len(table["push"].unique())


def test_a_folder_of_recordings(capsys):
    folder, _ = folder_of_films()
    words = ["criticize", str(folder), "--simulator", f"{folder}/my_swing.py:place"]
    words += ["--theta-low=0.1", "--theta-high=1", "--noise=0.004", "--seed=3"]
    for column in ("time=time_ms", "x=x_place", "action=action_speed", "role=role"):
        words += ["--columns", column]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Verdict: drag")
    assert "held-out trial push 3: " in printed


def test_a_task_gives_its_simulator_and_prior(capsys):
    actions = [-4.0, -2.0, 0.0, 2.0, 4.0, -3.0]
    task = get_task("numerical")
    x = [
        float(task.real_system(torch.tensor([a]), seed=k))
        for k, a in enumerate(actions)
    ]
    write([f"{a},{v:.3f}" for a, v in zip(actions, x, strict=True)], "action_xi,x_y")
    assert main(["criticize", "trials.csv", "--task", "numerical"]) == 0
    assert capsys.readouterr().out.startswith("Verdict: none")


def test_trials_of_another_shape_than_a_task_s(tmp_path, capsys):
    (tmp_path / "t.csv").write_text("action_1,x_1\n0.5,1\n1.0,2\n1.5,3\n")
    words = ["criticize", str(tmp_path / "t.csv"), "--task", "ball_drops"]
    assert main(words) == 2
    assert "expected x of 60 samples" in capsys.readouterr().err
