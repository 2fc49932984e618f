"""Sets with a truth, rows that are not run twice, and what the table makes of them."""

import importlib.util

import mujoco
import numpy as np
import pandas as pd
import pytest

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "Parameter"):
    pytest.skip(
        "needs mujoco.sysid; run pip install 'sbi-active[sysid]'",
        allow_module_level=True,
    )

from benchmarks.__main__ import main as run  # noqa: E402
from benchmarks.robots.coverage import missing, table  # noqa: E402
from benchmarks.robots.machines import MACHINES, recorded  # noqa: E402


def test_conditions_differ_in_what_they_say():
    machine = MACHINES["spring-mass"]
    sets = {c: recorded(machine, c, 3) for c in ("white", "AR .98", "friction 1")}
    x = {c: s.sequences.sensordata[0].data for c, s in sets.items()}
    assert (sets["white"].truth == sets["friction 1"].truth).all()
    assert (
        recorded(machine, "white", 3).sequences.sensordata[0].data == x["white"]
    ).all()
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(x["white"], x["friction 1"], atol=0.05)
    errors = x["AR .98"] - x["white"]  # of one motion, the white ones out of the same
    assert np.abs(errors).max() < 10 * max(machine.noise)
    # What is fitted has no friction, and its parameters are not the truth.
    model = sets["friction 1"].sequences.spec.compile()
    assert model.dof_frictionloss.max() == 0
    low, high = sets["white"].params.get_bounds()
    assert ((low < sets["white"].truth) & (sets["white"].truth < high)).all()


def test_rows_are_run_once_and_told(tmp_path, capsys):
    out = tmp_path / "coverage.csv"
    command = [
        "robots.coverage",
        "--seeds",
        "2000",
        "2001",
        "--conditions",
        "friction 1",
    ]
    run([*command, "--out", str(out)])
    rows = pd.read_csv(out)
    assert rows.groupby("way").size().to_dict() == {"bare": 2, "ours": 2, "sysid": 2}
    inside = (rows.low <= rows.truth) & (rows.truth <= rows.high)
    assert inside[rows.way == "ours"].all()
    assert not inside[rows.way == "sysid"].any()
    run([*command, "--out", str(out)])
    assert len(pd.read_csv(out)) == len(rows)
    capsys.readouterr()
    run(["robots.coverage", "--summary", "--by-parameter", "--out", str(out)])
    assert "| ours  | 1      | 1.00 (0.34 to 1.00)" in capsys.readouterr().out
    run(["robots.coverage", "--summary", "--out", str(out)])
    assert "| friction 1  | 0.00    | 1.00   | 1.00" in capsys.readouterr().out


def test_the_table_counts():
    rows = pd.DataFrame(
        {
            "machine": "m",
            "condition": "c",
            "seed": [1, 1, 2, 2],
            "way": "ours",
            "parameter": ["a", "b"] * 2,
            "truth": 0.0,
            "low": [-1.0, -1.0, 1.0, -3.0],
            "high": [1.0, 1.0, 2.0, 3.0],
            "cpu_seconds": [1.0, 1.0, 3.0, 3.0],
        }
    )
    (row,) = table(rows).to_dict("records")
    assert row["sets"] == 2
    assert row["coverage"].startswith("0.75")
    assert row["by parameter (median half width)"] == "a 0.50 (0.75), b 1.00 (2)"
    assert row["CPU s"] == "2.00"


@pytest.mark.parametrize("name", [*MACHINES])
def test_machines_are_made_or_say_what_they_need(name):
    if words := missing(name):
        assert name in ("Go2 leg", "swimmer")
        assert importlib.util.find_spec("gymnasium") is None or name == "Go2 leg"
        assert "cannot be made here" in words
        return
    machine = MACHINES[name]
    model = machine.spec().compile()
    assert isinstance(model, mujoco.MjModel)
    assert model.nu == len(machine.drive)
    assert model.nsensordata == len(machine.noise)
    assert model.nq == len(machine.start)
