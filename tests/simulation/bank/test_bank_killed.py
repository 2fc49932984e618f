import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("killed_writer.py")


@pytest.mark.parametrize(
    ("num_moments", "seed", "num_workers"),
    [
        (3, 0, 1),
        pytest.param(10, 1, 1, marks=pytest.mark.slow),
        pytest.param(4, 2, 2, marks=pytest.mark.slow),
    ],
)
def test_sigkill_loses_nothing_that_was_reported(
    num_moments, seed, num_workers, tmp_path
):
    options = map(str, (num_moments, seed, num_workers))
    command = [sys.executable, SCRIPT, tmp_path, *options]
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    assert ran.stderr == ""  # workers end silently
    records = [json.loads(line) for line in ran.stdout.splitlines()]
    assert len(records) == num_moments
    # Some moments come before the last row, some after the first.
    assert any(record["killed"] for record in records)
    assert any(0 < record["reported"] < record["rows"] for record in records)
    for record in records:
        assert num_workers == 1 or record["reported"]
        assert record["problems"] == []
        assert record.get("lost", 0) == 0
        assert record.get("same", True)
        assert record["resumed"]
        assert record["rows"] == 480
