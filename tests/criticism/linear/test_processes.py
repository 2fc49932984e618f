"""Whitened rows are those of the covariance that the errors have."""

import numpy as np
import pytest
import torch

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.processes import (
    Filter,
    Filters,
    Processes,
    time_scales,
    white_variance,
)

VARIANCES = np.array([[0.03, 0.97], [1e-4, 1.0], [1.0, 25.0], [1.0, 0.0]])


def covariance(time, own, k, process):
    apart = np.abs(time[:, None] - time) / own.time[k]
    kernel = np.exp(-apart)
    if own.smooth[k]:
        kernel = (1 + np.sqrt(3) * apart) * np.exp(-np.sqrt(3) * apart)
    return own.white[k] * np.eye(len(time)) + process * kernel


@pytest.fixture
def measurements():
    """Two trials of two channels, of which one has gaps."""
    rng = np.random.default_rng(0)
    x = torch.tensor(rng.standard_normal((2, 30, 2)))
    x[1, 4:9, 0] = torch.nan
    times = torch.tensor(np.sort(rng.uniform(0, 3, 30)))
    return Measurements.of(Trials(torch.zeros(2, 1), x, sample_times=times))


def test_filters_whiten_by_the_dense_covariance(measurements):
    m, rng = measurements, np.random.default_rng(1)
    own = Processes.grid(VARIANCES, time_scales(m, m.trial))
    rows = rng.standard_normal((len(m), 3))
    # Trials in two parts each, whose processes are their own.
    fold = 2 * m.trial + (m.time > 1.5)
    filters = Filters(own, m, fold, 4 * m.channel + fold)
    found = filters.grams(rows)
    assert found.gram.shape == (len(own), 8, 3, 3)
    for g in range(8):
        at = filters.group == g
        assert found.count[g] == at.sum()
        for k in (0, 1, 2, 3, 30, 41, len(own) - 2):
            dense = covariance(m.time[at], own, k, own.process[k])
            gram = rows[at].T @ np.linalg.solve(dense, rows[at])
            assert found.gram[k, g] == pytest.approx(gram, rel=1e-6)
            log_det = np.linalg.slogdet(dense)[1]
            assert found.log_det[k, g] == pytest.approx(log_det, rel=1e-6, abs=1e-8)


def test_long_series_are_filtered_piece_by_piece(measurements):
    m = measurements
    rows = np.random.default_rng(2).standard_normal((1, 60, 2))
    time = np.arange(60.0)
    own = Processes.grid(VARIANCES, time_scales(m, m.trial))
    whole, pieces = Filter(own, time), Filter(own, time, most=8 * len(own))
    assert pieces.grams(rows) == pytest.approx(whole.grams(rows))
    assert pieces.whitened(rows) == pytest.approx(whole.whitened(rows))


def test_what_is_white_has_its_variance_beside_a_process():
    """Of 20 trials of 100 numbers, to 4 %; without a time axis it is not known."""
    rng, time = np.random.default_rng(2), np.linspace(0, 6, 100)
    lasting = 5 * np.sin(time + rng.uniform(0, 6, (20, 1)))
    x = torch.tensor(lasting + 0.3 * rng.standard_normal((20, 100)))
    actions = torch.zeros(20, 1)
    m = Measurements.of(Trials(actions, x, sample_times=torch.tensor(time)))
    assert white_variance(m.x, m, m.trial) == pytest.approx(0.09, rel=0.15)
    m = Measurements.of(Trials(actions, x))
    assert white_variance(m.x, m, m.trial) == 0
