"""What tells causes from imitations: claims of cases, and the table of them."""

import numpy as np
import pytest

from benchmarks.__main__ import main as run
from benchmarks.misfit.odds import COLUMNS, claims, table
from benchmarks.rows import append, read


def rows_of(gained):
    """Two machines of twenty claims, of which every other one is of a cause."""
    factors = {"declared": 8, "helping": 1, "at_bounds": 0, "error": 2.0, "timed": True}
    factors["guessed"] = -np.inf
    return [
        factors
        | {"group": "own", "machine": machine, "kind": "E", "case": i, "effect": "a"}
        | {"right": i % 2, "cause": 0.5, "remains": 0.2, "gained": gained(i % 2)}
        for machine in ("tanks", "spring")
        for i in range(20)
    ]


def test_the_table_says_which_factor_tells(tmp_path):
    path = tmp_path / "odds.csv"
    append(path, COLUMNS, rows_of(lambda right: 90.0 if right else 2.0))
    append(path, COLUMNS, [{"group": "own", "machine": "tanks", "case": 99}])
    lines = table(read(path))
    assert lines[0].startswith("40 effects that help, 20 of them there, 2 machines")
    area = {line.split("|")[1].strip(): line.split("|")[2] for line in lines[4:]}
    assert float(area["nats gained"]) == float(area["the odds as they are"]) == 1.0
    for name in ("what remains", "all but nats gained"):
        assert float(area[name]) == 0.5, name


def test_claims_have_the_factors_of_their_odds():
    rows = claims("letters", "E", 600)
    assert len(rows) >= 1
    for row in rows:
        assert row["machine"] == "A"
        assert {*row} == {*COLUMNS}
        assert row["right"] in (0, 1)
        assert 0 <= row["cause"] < 1
        assert np.isfinite([row["gained"], row["error"], row["remains"]]).all()


def test_cases_that_judge_are_refused(tmp_path):
    out = tmp_path / "odds.csv"
    with pytest.raises(SystemExit, match="expected cases below 1000"):
        run(["misfit.odds", "--first", "990", "--cases", "20", "--out", str(out)])
    assert not out.exists()
