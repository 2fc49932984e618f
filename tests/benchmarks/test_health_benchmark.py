"""The benchmark of false alarms loses what it should and counts what it should."""

import math

import pytest
import torch

from benchmarks.robustness.health import SHARE, ends_early, linear


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
