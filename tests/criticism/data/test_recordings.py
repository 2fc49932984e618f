"""Trials from a folder of recordings."""

from pathlib import Path

import pytest

from sbi_active.criticism import Trials

HEADER = "time_ms,action_speed[m/s],x_height[m]"


def write(name, *rows, header=HEADER):
    Path("runs").mkdir(exist_ok=True)
    (Path("runs") / name).write_text("\n".join([header, *rows]) + "\n")


def test_a_file_a_trial():
    write("run_10.csv", "0,2,5.2", "100,2,5.1", "300,2,4.0")
    write("run_2.csv", "0,1,5.0", "100,1,4.9")
    trials = Trials.from_csv("runs", order="unknown")
    assert trials.names == ("run_2", "run_10")
    assert trials.action.tolist() == [[1], [2]]
    assert trials.sample_times[1].tolist() == pytest.approx([0, 0.1, 0.3])
    assert trials.x[0].nan_to_num(-1).tolist() == [5.0, 4.9, -1]
    assert trials.channel_labels == ("height [m]",)
    assert trials.order == "unknown"


def test_files_of_several_trials_have_the_file_in_the_name():
    header = f"trial,{HEADER}"
    write("monday.csv", "1,0,1,5", "1,100,1,4", "2,0,2,5", header=header)
    write("tuesday.csv", "1,0,1,5.5", "1,100,1,4", header=header)
    trials = Trials.from_csv("runs")
    assert trials.names == ("monday 1", "monday 2", "tuesday 1")


def test_files_where_a_row_is_a_trial_go_on_from_each_other():
    write("a.csv", "1,2", "2,3", header="action_v,x_y")
    write("b.csv", "4,5", header="action_v,x_y")
    trials = Trials.from_csv("runs")
    assert trials.action[:, 0].tolist() == [1, 2, 4]
    assert trials.names == ("0", "1", "2")


def test_recordings_whose_trials_stand_in_a_column_of_another_name():
    columns = {"trial": "ball", "time": "t", "x": "h", "action": "u"}
    for name, height in (("a.csv", 5), ("b.csv", 7)):
        rows = [f"{ball},0,1,{height + ball}" for ball in (1, 2)]
        write(name, *rows, header="ball,t,u,h")
    trials = Trials.from_csv("runs", columns=columns)
    assert trials.names == ("a 1", "a 2", "b 1", "b 2")
    assert trials.x[:, 0].tolist() == [6, 7, 8, 9]


def test_what_is_wrong_is_said_with_its_file_and_row():
    write("a.csv", "0,1,5", "100,1,6")
    write("b.csv", "0,1,5.5", "100,1,5 m")
    with pytest.raises(ValueError, match=r"column x_height\[m\], row 2 .*runs/b.csv"):
        Trials.from_csv("runs")
    write("b.csv", "0,1,5.5", "100,1,", header=HEADER)
    with pytest.warns(UserWarning, match="hold no number") as noted:
        Trials.from_csv("runs")
    (one,) = [str(note.message) for note in noted]
    assert "of column x_height[m] in runs hold no number: row 2 (trial b)" in one
    assert noted[0].filename == __file__


def test_recordings_with_other_columns_or_the_same_numbers_are_refused():
    write("a.csv", "0,1,5", "100,1,6")
    write("b.csv", "0,1,5", header="time_s,action_speed[m/s],x_height[m]")
    with pytest.raises(ValueError, match=r"same columns .* time_s.* in runs/b\.csv"):
        Trials.from_csv("runs")
    write("b.csv", "0,1,5", "100,1,6")
    with pytest.raises(ValueError, match="same numbers in trials a and b of runs"):
        Trials.from_csv("runs")
    write("b.csv")
    with pytest.raises(ValueError, match=r"a header, and .* no rows in runs/b\.csv"):
        Trials.from_csv("runs")
    Path("empty").mkdir()
    with pytest.raises(ValueError, match="expected recordings in empty; got no"):
        Trials.from_csv("empty")
