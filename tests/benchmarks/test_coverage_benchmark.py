"""Sets with a truth, rows that are not run twice, and what the table makes of them."""

import pandas as pd
import pytest

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "Parameter"):
    pytest.skip(
        "needs mujoco.sysid; run pip install 'sbi-active[sysid]'",
        allow_module_level=True,
    )

from benchmarks.__main__ import main as run  # noqa: E402


def test_rows_are_run_once_and_told(tmp_path, capsys):
    out = tmp_path / "coverage.csv"
    command = [
        "robots.coverage",
        "--seeds",
        "2000",
        "2001",
        "--machine",
        "spring-mass",
        "--condition",
        "friction 1",
        "--way",
        "sysid",
        "ours",
        "bare",
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
    run(["robots.coverage", "--summary", "--out", str(out)])
    assert "| friction 1 | 0.00 | 1.00 | 1.00 | - |" in capsys.readouterr().out
