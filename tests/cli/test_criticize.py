"""``sbi-active criticize``: from a file to a report."""

import math

import pytest
import torch

from sbi_active.cli import main
from sbi_active.criticism import Trials

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


def measure(drag=0.004):
    """Write trials of a robot with drag, three of them held out."""
    gen = torch.Generator().manual_seed(0)
    rows = []
    for i, v in enumerate(SPEEDS):
        x = v**2 / (2 * 9.81 * 0.4) - drag * v**4
        x += 0.005 * float(torch.randn((), generator=gen))
        rows.append(f"{v},{x:.4f},{'fit' if i < 8 else 'held out'}")
    write(rows, "action_speed,x_distance,role")


def run(*options):
    with open("my_robot.py", "w") as file:
        file.write(ROBOT)
    return main(["criticize", "trials.csv", *options])


def test_a_file_gives_a_report(capsys):
    measure()
    options = [*OPTIONS, "--effects", "my_robot:effects", "--actions", "0.5:3:11"]
    assert run("--simulator", "my_robot:distance", *options, "--out", "found") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Verdict: drag (P")
    assert "3 held-out trials" in printed
    assert "saved: found/report.html" in printed
    with open("found/report.txt") as file:
        assert file.read().strip() in printed


def test_a_task_brings_prior_noise_and_actions(capsys):
    rows = [f"{a},{-3 * math.exp(3 - a) + a},fit" for a in (0, 3, 1, 4, 2)]
    write([*rows, "5,4.6,held out"], "action_xi,x_y,role")
    assert run("--task", "numerical") == 0
    assert capsys.readouterr().out.startswith("Verdict: none")


def test_a_table_with_all_columns():
    write(
        ["1,0.3,,5,", "2,,fit,7,", "1,0.4,held out,9,5"],
        "action_speed,x_distance,role,index,repeat_of",
    )
    trials = Trials.from_csv("trials.csv")
    assert trials.role == ["fit", "fit", "held out"]
    assert trials.index.tolist() == [5, 7, 9]
    assert trials.repeat_of.tolist() == [-1, -1, 0]
    assert trials.valid.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        (["1,2"], "speed,x_distance", r"expected columns action_\*; got speed, x_dist"),
        (["1,2"], "action_speed,distance", r"expected columns x_\*; got action_speed"),
        (["1,2,3"], "action_v,x_y,mass", "expected columns .*; got mass in"),
        (["1,2", "nan,3"], "action_v,x_y", "finite number in column action_v, row 2"),
        (["1,2", ",3"], "action_v,x_y", "row 2; got an empty cell"),
        (["1,far"], "action_v,x_y", "a number in column x_y, row 1; got 'far'"),
        (["1,2", "3,4", "1,2"], "action_v,x_y", "the same numbers in rows 1 and 3"),
        (["1,2,0", "3,4,0"], "action_v,x_y,index", "got index 0 in rows 1 and 2"),
        (["1,2,4"], "action_v,x_y,repeat_of", "an index of the table; got 4"),
        (["1,2", "1,2,3,4"], "action_v,x_y", "as many cells in each row"),
        ([], "action_v,x_y", "one row a trial; got 0 rows"),
        (["1,", "2,"], "action_v,x_y", "expected at least one valid trial"),
        (["1,2,tested"], "action_v,x_y,role", "a role 'fit' or 'held out'"),
        (["1,2,fit", "2,,held out"], "action_v,x_y,role", "in the held-out trials"),
    ],
)
def test_a_table_that_is_not_understood(rows, header, message):
    write(rows, header)
    with pytest.raises(ValueError, match=message):
        Trials.from_csv("trials.csv")


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
