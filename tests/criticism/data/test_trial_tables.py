"""Trials from tables and folders: what is read, and what a user is told of it."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active.criticism import Trials

LONG = "trial,time[s],action_speed[m/s],x_height[m]"
SAMPLES = ["a,0,1,5.0", "a,0.1,1,4.9", "b,0,2,5.2", "b,0.1,2,5.1", "b,0.3,2,4.0"]


def read(rows, header=LONG, **options):
    with open("trials.csv", "w") as file:
        file.write("\n".join([header, *rows]) + "\n")
    return Trials.from_csv("trials.csv", **options)


OTHER = {"trial": ["ball", "drop"], "time": "t", "x": "h", "action": "area"}
ROLES = {"role": ["fit", "held out"], "index": [7, 9], "repeat_of": [-1, 0]}
#: Table, options, and what is read.
READ = [
    ("action_v,x_y|1,2|3,4", {}, {"names": ("0", "1"), "action_labels": ("v",)}),
    ("action_v,x_y|1,2", {"units": {"x_y": "px"}}, {"channel_labels": ("y [px]",)}),
    ("action_v,x_y|1,2", {"order": "unknown"}, {"order": "unknown"}),
    (
        "ball,drop,t,h,area|golf,1,0,5,1|golf,1,1,4,1|golf,2,0,6,1",
        {"columns": OTHER},
        {"names": ("golf 1", "golf 2"), "x": [[5, 4], [6, -1]]},
    ),
    (
        "trial,time,action_v,x_a,x_b|1,0,1,5,6|1,1,1,7,8|2,0,1,,9",
        {},
        {"x": [[[5, 6], [7, 8]], [[-1, 9], [-1, -1]]]},
    ),
    (
        "trial,time,action,x,role,index,repeat_of|a,0,1,5,fit,7,|b,0,1,6,held out,9,7",
        {},
        ROLES,
    ),
    (
        "time [ns],action_v,x_h,trial|0,1,.1,run#1|20000000,1,.2,run#1|# a comment",
        {},
        {"sample_times": [[0.0, 0.02]], "names": ("run#1",)},
    ),
]


@pytest.mark.parametrize(("table", "options", "expected"), READ)
def test_what_is_read(table, options, expected):
    header, *rows = table.split("|")
    found = read(rows, header, **options)
    for name, value in expected.items():
        own = getattr(found, name)
        own = own.nan_to_num(-1).tolist() if hasattr(own, "tolist") else own
        assert own == value, name


def test_a_frame_is_read_as_its_file():
    trials = read([*SAMPLES])
    frame = pd.read_csv("trials.csv")
    same = Trials.from_dataframe(frame, order="unknown")
    assert same.order == "unknown"
    assert same.x.nan_to_num(0).equal(trials.x.nan_to_num(0))
    assert same.action_labels == trials.action_labels
    assert trials[1:].channel_labels == ("height [m]",)  # a part keeps its own
    frame.loc[1, "x_height[m]"] = np.nan
    with pytest.warns(UserWarning, match=r"1 of 5 cells .* row 2 \(trial a\)") as noted:
        lost = Trials.from_dataframe(frame)
    assert noted[0].filename == __file__
    assert lost.mask[0].tolist() == [True, False, False]


SHORT = "trial,time,action_v,x_y"
#: Tables that are not understood, and what is said of them.
BAD = [
    ("trial,action_v,x_y|1,2,3", "columns time, action_.*; got .*trials.csv"),
    (f"{SHORT},mass|1,0,1,2,3", "got mass in trials.csv"),
    (f"{SHORT}[m],x_y[cm]|1,0,1,2,3", r"x_y\[m\] and x_y\[cm\]"),
    (f"{SHORT}|1,0,1,5|1,1,1,4 cm", r"row 2 \(trial 1\); got 4 cm"),
    (f'{SHORT}|1,0,1,"5,2"', "got 5,2 in trials.csv"),
    (f"{SHORT}|1,0,1,5|1,,1,4", "number in column time, row 2"),
    (f"{SHORT}|1,0,1,5|1,1,nan,4", r"action_v, row 2 \(trial 1\); got nan"),
    (f"{SHORT}|1,0,1,5|1,1,2,4", "action_v, row 2 .*; got 2.0 after 1.0 in trials"),
    (f"{SHORT}|1,0,1,5|2,0,1,4|1,0,1,5", r"row 3 \(trial 1\); got 0.0 after 0.0 in"),
    (f"{SHORT}|1,0,1,5|2,0,1,5", "the same numbers in trials 1 and 2 of trials"),
    (f"{SHORT},role|1,0,1,5,fit|1,1,1,4,held out", "one value .* column role, row 2"),
    (f"{SHORT},role|1,0,1,5,|3,0,1,6,test", "role, row 2 .*; got test in trials"),
    (f"{SHORT},index|1,0,1,5,3|2,0,1,4,3", "got index 3 in trials 1 and 2"),
    (f"{SHORT}|1,0,1,5".replace(",", "\t"), "separated by commas; got .*sep="),
    ("trial;action_v;x_y|1;1,5;0,2|2;2,5;0,4", "separated by commas; got 'trial;a"),
    (f"{SHORT}|1,0,5,1,5,2", "got 'Expected 4 fields in line 2, saw 6' in tr"),
    ("", "names of columns, .* got 'No columns .* in trials.csv"),
    (f"{SHORT}|1,0,1,", "at least one valid trial"),
    (f"{SHORT.replace('v', 'u')}|a,0,1,5|a,1,2,5", r"action_u, .* got 2.0 .*input_"),
    (
        "trial,time,input_u,x_y" + "".join(f"|a,{t},1,5" for t in (0, 1, 2, 9, 10)),
        "no value from 2 to 9 for input 'u' of trial a",
    ),
]


@pytest.mark.parametrize(("table", "message"), BAD)
@pytest.mark.filterwarnings("ignore:.*hold no number")
def test_a_long_table_that_is_not_understood(table, message):
    header, *rows = table.split("|")
    with pytest.raises(ValueError, match=message):
        read(rows, header)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_table_in_another_encoding(encoding):
    with open("trials.csv", "w", encoding=encoding) as file:
        file.write("action_v,x_y[°]\n1,2\n")
    with pytest.raises(ValueError, match="expected text in UTF-8, .* in trials.csv"):
        Trials.from_csv("trials.csv")


#: Options, and what is said of them.
UNFIT = [
    ({"columns": {"y": "x_y"}}, "columns of trial, time, .*; got y"),
    ({"columns": {"x": "x_z"}}, "a column x_z; got .*'x_y'"),
    ({"columns": {"time": ["time", "x_y"]}}, "one column for time; got time, x_y"),
    ({"units": {"x_z": "m"}}, "a column x_z; got .*'x_y'"),
    ({"order": "sorted"}, "expected order 'known' or 'unknown'; got"),
]


@pytest.mark.parametrize(("options", "message"), UNFIT)
def test_options_that_do_not_fit_the_table(options, message):
    with pytest.raises(ValueError, match=message):
        read(["1,0,1,5"], SHORT, **options)


# Cells of tables: what names a trial, when it was, and what is no number


def long(**changes):
    """Return a long table of two trials with two samples each."""
    columns = {
        "trial": ["a"] * 2 + ["b"] * 2,
        "time": [0.0, 1.0, 0.0, 1.0],
        "action_v": 1.0,
        "x_h": [0.1, 0.2, 0.3, 0.4],
    }
    return pd.DataFrame({**columns, **changes})


#: Numbers, and the names of trials.
DIGITS = [
    ([20261101.0, 20261102.0], ("20261101", "20261102")),
    ([1e15, 1e15 + 1], ("1000000000000000", "1000000000000001")),
]


@pytest.mark.parametrize(("ids", "names"), DIGITS)
def test_numbers_that_name_trials_keep_their_digits(ids, names):
    trials = Trials.from_dataframe(long(trial=np.repeat(ids, 2)))
    assert trials.names == names


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC"])
def test_dates_are_seconds_from_the_start_of_each_trial(unit, zone):
    day = np.datetime64("2026-11-26")
    stamps = day + np.array([0, 20, 5_000, 5_020]).astype("timedelta64[ms]")
    time = pd.Series(stamps.astype(f"datetime64[{unit}]")).dt.tz_localize(zone)
    trials = Trials.from_dataframe(long(time=time))
    times = trials.sample_times.expand(2, -1)
    assert times.flatten().tolist() == pytest.approx([0.0, 0.02, 0.0, 0.02])


def test_files_of_attributes_are_no_recordings():
    for name in ("run_1", "run_2"):
        write_run(f"{name}.csv", "0,1,.1", f"1,1,.{name[-1]}")
        Path(f"runs/._{name}.csv").write_bytes(b"\x00\x05\x16\x07")
    assert Trials.from_csv("runs").names == ("run_1", "run_2")


@pytest.mark.filterwarnings("error")
def test_sensors_of_other_rates_are_no_lack():
    nan = float("nan")
    frame = long(x_h=[0.1, nan, 0.3, nan], x_w=[nan, 0.2, nan, 0.4])
    trials = Trials.from_dataframe(frame)
    assert int(trials.mask.sum()) == 4


# Trials from a folder of recordings


HEADER = "time_ms,action_speed[m/s],x_height[m]"


def write_run(name, *rows, header=HEADER):
    Path("runs").mkdir(exist_ok=True)
    (Path("runs") / name).write_text("\n".join([header, *rows]) + "\n")


def test_a_file_a_trial():
    write_run("run_10.csv", "0,2,5.2", "100,2,5.1", "300,2,4.0")
    write_run("run_2.csv", "0,1,5.0", "100,1,4.9")
    trials = Trials.from_csv("runs", order="unknown")
    assert trials.names == ("run_2", "run_10")
    assert trials.sample_times[1].tolist() == pytest.approx([0, 0.1, 0.3])
    assert trials.x[0].nan_to_num(-1).tolist() == [5.0, 4.9, -1]
    assert trials.order == "unknown"


BALLS = {"trial": "ball", "time": "t", "x": "h", "action": "u"}


#: Headers, columns, first rows, and names.
SEVERAL = [
    ("action_v,x_y", None, ["1,2", "2,3"], ("0", "1", "2")),
    (f"trial,{HEADER}", None, ["1,0,1,5", "2,0,2,5"], ("a 1", "a 2", "b 1")),
    ("ball,t,u,h", BALLS, ["1,0,1,6", "2,0,1,7"], ("a 1", "a 2", "b 1")),
]


@pytest.mark.parametrize(("header", "columns", "first", "names"), SEVERAL)
def test_files_of_several_trials_name_their_file(header, columns, first, names):
    write_run("a.csv", *first, header=header)
    write_run("b.csv", first[0] + ".5", header=header)
    assert Trials.from_csv("runs", columns=columns).names == names


#: Rows and header of a second file, and what is said of it.
APART = [
    (["0,1,5"], "time_s,action_speed[m/s],x_height[m]", r"columns .*runs/b\.csv"),
    (["0,1,5", "100,1,6"], HEADER, "same numbers in trials a and b of runs"),
    (["0,1,5.5", "1,1,5 m"], HEADER, r"x_height\[m\], row 2 .*runs/b.csv"),
    ([], HEADER, r"no rows in runs/b\.csv"),
]


@pytest.mark.parametrize(("rows", "header", "message"), APART)
def test_recordings_that_do_not_go_together(rows, header, message, tmp_path):
    with pytest.raises(ValueError, match="expected recordings in .*; got no"):
        Trials.from_csv(tmp_path)
    write_run("a.csv", "0,1,5", "100,1,6")
    write_run("b.csv", *rows, header=header)
    with pytest.raises(ValueError, match=message):
        Trials.from_csv("runs")


# Inputs over time and start states from tables


#: Table, what its inputs and x are, and the code of what is said.
INPUTS = {
    "rows of inputs alone": (
        "trial,time_ms,input_u,x_y|a,0,1,0.1|a,10,2,|b,0,1,0.3|b,10,2,",
        *({"u": [[1, 2]] * 2}, [[0.1], [0.3]], ""),
    ),
    "rows of x alone hold the input": (
        "trial,time_ms,input_u,x_y|a,0,1,0.1|a,10,2,0.3|a,15,,0.2|a,20,4,0.5",
        *({"u": [[1, 2, 4]]}, [[0.1, 0.3, 0.2, 0.5]], "SA209"),
    ),
    "rows of each input alone, of a log of several topics": (
        "trial,time,input_u,input_v,x_y|a,0,1,,|a,0.1,,5,|a,0.5,,,7|a,1,2,,|a,1.1,,6,"
        "|a,1.5,,,8",
        *({"u": [[1, 2, 2]], "v": [[5, 5, 6]]}, [[7, 8]], "SA209"),
    ),
}


@pytest.mark.parametrize("case", INPUTS)
def test_inputs_of_a_table(case, recwarn):
    table, inputs, x, code = INPUTS[case]
    header, *rows = table.split("|")
    found = read(rows, header)
    assert {k: v.tolist() for k, v in found.inputs.items()} == inputs
    assert found.x.tolist() == x
    assert "".join(getattr(w.message, "code", "") for w in recwarn) == code


def test_inputs_and_starts_stand_beside_x():
    header = "trial,time_ms,input_voltage[V],x_speed[rad/s],start_angle[rad]"
    rows = ["a,0,1,0.1,.5", "a,100,2,0.2,.5", "b,0,3,0.3,.7", "b,100,4,0.4,.7"]
    trials = read(rows, header)
    assert trials.action_is_label
    assert trials.inputs["voltage"].tolist() == [[1, 2], [3, 4]]
    assert trials.input_labels == ("voltage [V]",)
    assert trials.input_times.tolist() == [0, 0.1]
    assert trials.start["angle"].tolist() == [0.5, 0.7]


def test_inputs_come_from_another_file_on_their_own_grid():
    columns = {"trial": [*"aaabbbcc"], "time_ms": [0, 10, 20, 0, 10, 20, 0, 10]}
    other = pd.DataFrame({**columns, "input_u[V]": [1, 2, 3, 4, 5, 6, 0, 0]})
    other.to_csv("inputs.csv", index=False)
    rows = ["a,0,0.1", "a,0.02,0.2", "b,0.01,0.3"]
    trials = read(rows, "trial,time,x_y", inputs="inputs.csv")
    assert trials.inputs["u"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert trials.sample_times[0].tolist() == [0, 0.02]
    frame = pd.read_csv("trials.csv")
    again = Trials.from_dataframe(frame, inputs=other)
    assert torch.equal(again.inputs["u"], trials.inputs["u"])
    finer = other.assign(time_ms=[0, 10, 20, 0, 5, 10, 0, 10])
    lines = Trials.from_dataframe(frame, inputs=finer, input_hold="linear")
    assert lines.inputs["u"][0].tolist() == [1, 1.5, 2, 2.5, 3]
