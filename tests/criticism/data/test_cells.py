"""Cells of tables: what names a trial, when it was, and what is no number."""

import numpy as np
import pandas as pd
import pytest

from sbi_active.criticism import Trials

LONG = "time,action_v,x_h,trial\n"


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
    path.write_text("# made by hand\n" + LONG + rows)
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
