"""Trials from tables and folders: what is read, and what a user is told of it."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sbi_active.criticism import Trials

LONG = "trial,time[s],action_speed[m/s],x_height[m]"
SAMPLES = ["a,0,1,5.0", "a,0.1,1,4.9", "b,0,2,5.2", "b,0.1,2,5.1", "b,0.3,2,4.0"]


def read(rows, header=LONG, **options):
    with open("trials.csv", "w") as file:
        file.write("\n".join([header, *rows]) + "\n")
    return Trials.from_csv("trials.csv", **options)


def test_a_row_a_sample_gives_ragged_trials():
    trials = read(SAMPLES)
    assert trials.x.shape == (2, 3)
    assert trials.x[0].nan_to_num(-1).tolist() == [5.0, 4.9, -1]
    assert trials.sample_times[1].tolist() == [0, 0.1, 0.3]
    assert trials.action.tolist() == [[1], [2]]
    assert trials.role == ["fit", "fit"]


def test_units_of_the_header_are_carried_along():
    trials = read(SAMPLES)
    assert trials.action_labels == ("speed [m/s]",)
    assert trials.channel_labels == ("height [m]",)
    part = trials.select([1])
    assert part.channel_labels == ("height [m]",)
    named = read(["1,2"], "action_v,x_y", units={"x_y": "px"})
    assert (named.action_labels, named.channel_labels) == (("v",), ("y [px]",))
    assert named.x.item() == 2


def test_trials_are_called_as_in_the_table():
    assert read([*SAMPLES, "c,0,3,4"]).select([2, 0]).names == ("c", "a")
    header = "ball,drop,time_s,height_m,area"
    rows = ["golf,1,0,5,.1", "golf,1,.1,4,.1", "golf,2,0,6,.1"]
    told = {"trial": ["ball", "drop"], "time": "time_s"}
    told |= {"x": "height_m", "action": "area"}
    assert read(rows, header, columns=told).names == ("golf 1", "golf 2")
    assert read(["1,2", "3,4"], "action_v,x_y").names == ("0", "1")


def test_rows_in_no_order_are_declared_and_stay_so():
    trials = read([*SAMPLES, "c,0,3,4"], order="unknown")
    assert trials.order == trials.select([2, 0]).order == trials.fit.order == "unknown"
    frame = pd.DataFrame({"action_v": [1.0, 2.0], "x_y": [3.0, 4.0]})
    assert Trials.from_dataframe(frame, order="unknown").order == "unknown"
    assert Trials.from_dataframe(frame).order == "known"
    with pytest.raises(ValueError, match="expected order 'known' or 'unknown'; got"):
        read(SAMPLES, order="sorted")


def test_several_channels_stand_last():
    header = "trial,time,action_v,x_a,x_b"
    trials = read(["1,0,1,5,6", "1,1,1,7,8", "2,0,1,,9"], header)
    assert trials.x.shape == (2, 2, 2)
    assert trials.x[0].tolist() == [[5, 6], [7, 8]]
    assert trials.mask[1].tolist() == [[False, True], [False, False]]


def test_a_frame_is_read_as_its_file():
    trials = read([*SAMPLES])
    frame = pd.read_csv("trials.csv")
    same = Trials.from_dataframe(frame)
    assert same.x.nan_to_num(0).equal(trials.x.nan_to_num(0))
    assert same.action_labels == trials.action_labels
    frame.loc[1, "x_height[m]"] = np.nan
    with pytest.warns(UserWarning, match=r"1 of 5 cells .* row 2 \(trial a\)") as noted:
        lost = Trials.from_dataframe(frame)
    assert noted[0].filename == __file__
    assert lost.mask[0].tolist() == [True, False, False]


def test_what_belongs_to_a_trial_is_read_from_its_rows():
    header = "trial,time,action_v,x_y,role,index,repeat_of"
    rows = ["a,0,1,5,fit,7,", "a,1,1,4,fit,7,", "b,0,1,5,held out,9,7"]
    trials = read(rows, header)
    assert trials.role == ["fit", "held out"]
    assert trials.index.tolist() == [7, 9]
    assert trials.repeat_of.tolist() == [-1, 0]


SHORT = "trial,time,action_v,x_y"


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        (["1,2,3"], "trial,action_v,x_y", "columns trial, time, .*; got .*trials.csv"),
        (["1,0,1,2,3"], f"{SHORT},mass", "got mass in trials.csv; rename or"),
        (["1,0,1,2,3"], f"{SHORT}[m],x_y[cm]", r"x_y\[m\] and x_y\[cm\]"),
        (["1,0,1,5", "1,1,1,4 cm"], SHORT, r"row 2 \(trial 1\); got '4 cm' .*once, in"),
        (['1,0,1,"5,2"'], SHORT, "got '5,2' in trials.csv; write decimals with a"),
        (["1,0,1,5", "1,,1,4"], SHORT, r"number in column time, row 2 .*an empty cell"),
        (["1,0,1,5", "1,1,nan,4"], SHORT, r"action_v, row 2 \(trial 1\); got nan"),
        (["1,0,1,5", "1,1,2,4"], SHORT, "value of action_v .* row 1 and 2.0 in row 2"),
        (["1,0,1,5", "2,0,1,4", "1,0,1,5"], SHORT, "row 1 and row 3 .trial 1. of"),
        (["1,0,1,5", "2,0,1,5"], SHORT, "the same numbers in trials 1 and 2 of trials"),
        (["1,0,1,5,fit", "1,1,1,4,held out"], f"{SHORT},role", "value of role in each"),
        (
            ["1,0,1,5,", "2,0,1,4,held_out", "3,0,1,6,test"],
            f"{SHORT},role",
            r"'held out' in column role; got 'test' in row 3 \(trial 3\) of trials",
        ),
        (["1,0,1,5,3", "2,0,1,4,3"], f"{SHORT},index", "got index 3 in rows 1 and 2"),
        (["1\t0\t1\t5"], "trial\ttime\taction_v\tx_y", r"by commas.*sep='\\t'\)\)"),
        (["1,0,5,1,5,2"], SHORT, "got 'Expected 4 fields in line 2, saw 6' in tr"),
        ([], "", "names of columns, .* got 'No columns .* in trials.csv"),
        (["1,0,1,"], SHORT, "at least one valid trial"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*hold no number")
def test_a_long_table_that_is_not_understood(rows, header, message):
    with pytest.raises(ValueError, match=message):
        read(rows, header)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_table_in_another_encoding(encoding):
    with open("trials.csv", "w", encoding=encoding) as file:
        file.write("action_v,x_y[°]\n1,2\n")
    with pytest.raises(ValueError, match=r"text in UTF-8; got other bytes in trials"):
        Trials.from_csv("trials.csv")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"y": "x_y"}}, "columns of trial, time, .*; got y; say"),
        ({"columns": {"x": "x_z"}}, "a column x_z for x; got .*; did you mean 'x_y'"),
        ({"columns": {"time": ["time", "x_y"]}}, "one column for time; got time, x_y"),
        ({"units": {"x_z": "m"}}, "got one of x_z; correct the name"),
    ],
)
def test_options_that_do_not_fit_the_table(options, message):
    with pytest.raises(ValueError, match=message):
        read(["1,0,1,5"], SHORT, **options)


def test_a_trial_in_another_unit_is_noted():
    rows = [
        f"{t},{s},1,{(5 - s) * (1000 if t == 2 else 1) + t / 9}"
        for t in range(4)
        for s in (0, 1)
    ]
    with pytest.warns(UserWarning, match="x_y of trials 2 .* times larger"):
        read(rows, SHORT)
    fast = [
        f"{t},{s * (0.001 if t == 3 else 1)},1,{t + s}"
        for t in range(4)
        for s in (0, 1)
    ]
    with pytest.warns(UserWarning, match="time of trials 3 .* 1000 times smaller"):
        read(fast, SHORT)


@pytest.mark.filterwarnings("error")
def test_trials_that_differ_little_are_not_noted():
    rows = [f"{t},{s},{t + 1},{3.0**t + s}" for t in range(4) for s in (0, 1)]
    assert len(read(rows, SHORT)) == 4


# Cells of tables: what names a trial, when it was, and what is no number


LONG_HEADER = "time,action_v,x_h,trial\n"


def long(**changes):
    """Return a long table of two trials with two samples each."""
    columns = {
        "trial": ["a"] * 2 + ["b"] * 2,
        "time": [0.0, 1.0, 0.0, 1.0],
        "action_v": 1.0,
        "x_h": [0.1, 0.2, 0.3, 0.4],
    }
    return pd.DataFrame({**columns, **changes})


def test_a_number_sign_within_a_cell_is_data(tmp_path):
    path = tmp_path / "t.csv"
    rows = "0,1,.1,run#1\n1,1,.2,run#1\n# a comment\n0,1,.3,run#2\n1,1,.4,run#2\n"
    path.write_text("# made by hand\n" + LONG_HEADER + rows)
    assert Trials.from_csv(path).names == ("run#1", "run#2")


@pytest.mark.parametrize(
    ("ids", "names"),
    [
        ([20261101.0, 20261102.0], ("20261101", "20261102")),
        ([1e15, 1e15 + 1], ("1000000000000000", "1000000000000001")),
    ],
)
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


@pytest.mark.parametrize("name", ["time_ns", "time[ns]", "time [ns]"])
def test_nanoseconds_are_a_unit(name):
    frame = long(time=[0, 20_000_000, 0, 20_000_000])
    trials = Trials.from_dataframe(frame.rename(columns={"time": name}))
    assert trials.sample_times.flatten()[:2].tolist() == pytest.approx([0.0, 0.02])


def test_files_of_attributes_are_no_recordings(tmp_path):
    for name in ("run_1", "run_2"):
        (tmp_path / f"{name}.csv").write_text(
            f"time,action_v,x_h\n0,1,.1\n1,1,.{name[-1]}\n"
        )
        (tmp_path / f"._{name}.csv").write_bytes(b"\x00\x05\x16\x07")
    assert Trials.from_csv(tmp_path).names == ("run_1", "run_2")


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
    assert trials.action.tolist() == [[1], [2]]
    assert trials.sample_times[1].tolist() == pytest.approx([0, 0.1, 0.3])
    assert trials.x[0].nan_to_num(-1).tolist() == [5.0, 4.9, -1]
    assert trials.channel_labels == ("height [m]",)
    assert trials.order == "unknown"


def test_files_of_several_trials_have_the_file_in_the_name():
    header = f"trial,{HEADER}"
    write_run("monday.csv", "1,0,1,5", "1,100,1,4", "2,0,2,5", header=header)
    write_run("tuesday.csv", "1,0,1,5.5", "1,100,1,4", header=header)
    trials = Trials.from_csv("runs")
    assert trials.names == ("monday 1", "monday 2", "tuesday 1")


def test_files_where_a_row_is_a_trial_go_on_from_each_other():
    write_run("a.csv", "1,2", "2,3", header="action_v,x_y")
    write_run("b.csv", "4,5", header="action_v,x_y")
    trials = Trials.from_csv("runs")
    assert trials.action[:, 0].tolist() == [1, 2, 4]
    assert trials.names == ("0", "1", "2")


def test_recordings_whose_trials_stand_in_a_column_of_another_name():
    columns = {"trial": "ball", "time": "t", "x": "h", "action": "u"}
    for name, height in (("a.csv", 5), ("b.csv", 7)):
        rows = [f"{ball},0,1,{height + ball}" for ball in (1, 2)]
        write_run(name, *rows, header="ball,t,u,h")
    trials = Trials.from_csv("runs", columns=columns)
    assert trials.names == ("a 1", "a 2", "b 1", "b 2")
    assert trials.x[:, 0].tolist() == [6, 7, 8, 9]


def test_what_is_wrong_is_said_with_its_file_and_row():
    write_run("a.csv", "0,1,5", "100,1,6")
    write_run("b.csv", "0,1,5.5", "100,1,5 m")
    with pytest.raises(ValueError, match=r"column x_height\[m\], row 2 .*runs/b.csv"):
        Trials.from_csv("runs")
    write_run("b.csv", "0,1,5.5", "100,1,", header=HEADER)
    with pytest.warns(UserWarning, match="hold no number") as noted:
        Trials.from_csv("runs")
    (one,) = [str(note.message) for note in noted]
    assert "of column x_height[m] in runs hold no number: row 2 (trial b)" in one
    assert noted[0].filename == __file__


def test_recordings_with_other_columns_or_the_same_numbers_are_refused():
    write_run("a.csv", "0,1,5", "100,1,6")
    write_run("b.csv", "0,1,5", header="time_s,action_speed[m/s],x_height[m]")
    with pytest.raises(ValueError, match=r"same columns .* time_s.* in runs/b\.csv"):
        Trials.from_csv("runs")
    write_run("b.csv", "0,1,5", "100,1,6")
    with pytest.raises(ValueError, match="same numbers in trials a and b of runs"):
        Trials.from_csv("runs")
    write_run("b.csv")
    with pytest.raises(ValueError, match=r"a header, and .* no rows in runs/b\.csv"):
        Trials.from_csv("runs")
    Path("empty").mkdir()
    with pytest.raises(ValueError, match="expected recordings in empty; got no"):
        Trials.from_csv("empty")
