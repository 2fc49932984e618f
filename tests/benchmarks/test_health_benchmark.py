"""The benchmark of false alarms loses what it should and counts what it should."""

import math

import pytest
import torch

from benchmarks.robustness.health import SHARE, ends_early, interval, linear, summary


@pytest.mark.parametrize("q", [1, 10])
def test_a_fifth_of_the_rows_end_early(q):
    torch.manual_seed(0)
    x = ends_early(linear)(torch.zeros(2_000, 2), torch.ones(2_000, 1), q)
    lost = x.isnan().double().mean(0)
    error = math.sqrt(SHARE * (1 - SHARE) / 2_000)
    assert lost[q // 2 :].tolist() == pytest.approx(
        [SHARE] * (q - q // 2), abs=4 * error
    )
    assert not x[:, : q // 2].isnan().any()


def test_shares_by_cell():
    numbers = {f"{p}_{k}": "0.5" for p in ("surprise", "misfit") for k in (1, 2, 3)}
    row = {
        "numbers": "10",
        "lost": "sensor",
        "health": "ok",
        "untested": "0",
        "seconds": "1.0",
    } | numbers
    alarm = row | {"health": "alarm", "surprise_1": "0.001", "misfit_3": ""}
    lines = list(summary([row] * 9 + [alarm]))
    assert len(lines) == 2
    assert lines[1].split()[2:7] == ["10", "0.100", "[0.003,", "0.445]", "0.033"]
    assert interval(0, 10) == (0.0, pytest.approx(0.308, abs=1e-3))
