"""Units of headers: one reading of them, for tables and for logs of robots."""

import warnings

import numpy as np
import pandas as pd
import pytest

from benchmarks.robots.models import SPRING_MASS
from sbi_active.criticism import Trials
from sbi_active.criticism.data.units import to_si
from sbi_active.messages import ChangedWarning
from sbi_active.mujoco import from_mjcf

UNITS = {"time": "ms", "action_v": "deg/s", "x_y": "mm", "input_u": "mNm"}
ROWS = [(0, 180, 5, 1), (20, 180, -2, 3)]


@pytest.mark.parametrize(
    ("unit", "factor", "si"),
    [
        ("mm/s^2", 1e-3, "m/s^2"),
        ("m/s²", 1, "m/s²"),
        ("1/mm", 1e3, "1/m"),
        ("°", np.pi / 180, "rad"),
        ("rpm", np.pi / 30, "rad/s"),
        ("mNm", 1e-3, "N m"),
        ("N m s/rad", 1, "N m s/rad"),
        ("mm s-1", 1e-3, "m s-1"),
        ("min", 60, "s"),
    ],
)
def test_units_become_si(unit, factor, si):
    assert to_si(unit) == (pytest.approx(factor), si)


@pytest.mark.parametrize("unit", ["px", "%", "°C", "g", "counts", "[m]"])
def test_what_is_no_scale_of_an_si_unit_is_not_guessed(unit):
    assert to_si(unit) is None


@pytest.mark.parametrize("where", ["header", "units"])
def test_numbers_of_a_table_become_si(where):
    names, units = [*UNITS], UNITS
    if where == "header":
        names = [f"{name} [{unit}]" for name, unit in UNITS.items()]
        units = None
    frame = pd.DataFrame(ROWS, columns=names).assign(trial=1)
    with pytest.warns(ChangedWarning, match="action_v.* to rad/s, x_y.* to m, input_u"):
        trials = Trials.from_dataframe(frame, units=units)
    assert trials.sample_times.flatten().tolist() == [0, pytest.approx(0.02)]
    assert trials.action.item() == pytest.approx(np.pi)
    assert trials.x.flatten().tolist() == pytest.approx([0.005, -0.002])
    assert trials.inputs["u"].flatten().tolist() == pytest.approx([0.001, 0.003])
    assert trials.action_labels == ("v [rad/s]",)
    assert trials.channel_labels == ("y [m]",)


@pytest.mark.filterwarnings("ignore::sbi_active.messages.ChangedWarning")
def test_numbers_of_a_folder_become_si(tmp_path):
    names = [f"{name} [{unit}]" for name, unit in UNITS.items()]
    for shift in (1, 2):
        rows = [(time, v, y + shift, u) for time, v, y, u in ROWS]
        frame = pd.DataFrame(rows, columns=names)
        frame.to_csv(tmp_path / f"run_{shift}.csv", index=False)
    trials = Trials.from_csv(tmp_path)
    assert trials.x.flatten().tolist() == pytest.approx([0.006, -0.001, 0.007, 0.0])
    assert trials.channel_labels == ("y [m]",)


def logs(scale=1e3, units=("ms", "mm", "mm/s")):
    """Two logs at 100 Hz, of which the position was read at 10 Hz."""
    t = np.arange(0, 1, 0.01)
    time, position, speed = (f" [{unit}]" if unit else "" for unit in units)
    slow = np.where(np.arange(100) % 10, np.nan, t)
    frame = pd.DataFrame(
        {
            f"time{time}": scale * t,
            "push [N]": np.sin(5 * t),
            f"position{position}": scale * slow,
            f"speed{speed}": scale * t,
            f"start slide{position}": 0 * t + scale * 0.1,
        }
    )
    return [frame, frame * 1.0]


def read(recordings):
    robot = from_mjcf(
        SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=recordings, noise=0.01
    )
    assert robot.trials is not None
    return robot.trials


def test_logs_of_a_robot_become_si_as_tables_do(tmp_path):
    for k, log in enumerate(logs()):
        log.to_csv(tmp_path / f"{k}.csv", index=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        converted, same = read(tmp_path), read(logs(1.0, ("", "", "")))
    assert len(converted) == 2
    for name in ("x", "sample_times", "input_times"):
        found, expected = getattr(converted, name), getattr(same, name)
        assert np.allclose(found, expected, equal_nan=True), name
    assert converted.x[:, :, 0].isfinite().sum() == 20
    assert isinstance(converted.start, dict)
    assert converted.start["slide"].tolist() == pytest.approx([0.1, 0.1])


@pytest.mark.parametrize(
    ("units", "message"),
    [
        (("ms", "px", ""), r"'position' in m; got \[px\] in recording 0"),
        (("ms", "deg", ""), r"'position' in m; got \[deg\] in recording 0"),
        (("mm", "", ""), r"times in s, .* got mm"),
    ],
)
def test_units_that_cannot_be_those_of_the_model_are_refused(units, message):
    with pytest.raises(ValueError, match=f"expected {message}"):
        read(logs(units=units))


def test_one_column_in_two_units_is_refused():
    log = logs()[0].assign(**{"position [m]": 0.0})
    with pytest.raises(ValueError, match="each quantity once; got position .* and"):
        read([log])
