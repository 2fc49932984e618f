"""Whitened rows are those of the covariance that the errors have."""

import numpy as np
import pytest
import torch

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.identification.errors import Hypotheses, grams, whitened


def covariance(time, hypotheses, k):
    apart = np.abs(time[:, None] - time) / hypotheses.time[k]
    kernel = np.exp(-apart)
    if hypotheses.smooth[k]:
        kernel = (1 + np.sqrt(3) * apart) * np.exp(-np.sqrt(3) * apart)
    w = hypotheses.share[k]
    return w * np.eye(len(time)) + (1 - w) * kernel


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
    hypotheses = Hypotheses.of(m)
    assert hypotheses.share[0] == 1
    assert np.exp(hypotheses.log_prior).sum() == pytest.approx(1)
    rows = rng.standard_normal((len(m), 3))
    found = grams(rows, m, hypotheses, m.trial)
    for c in range(2):
        for k in (0, 1, 40, 77, len(hypotheses) - 1):
            gram, log_det = np.zeros((3, 3)), 0.0
            for t in range(2):
                at = (m.channel == c) & (m.trial == t)
                dense = covariance(m.time[at], hypotheses, k)
                gram += rows[at].T @ np.linalg.solve(dense, rows[at])
                log_det += np.linalg.slogdet(dense)[1]
            total, logs, count = found[c].total
            assert total[k] == pytest.approx(gram, rel=1e-6)
            assert logs[k] == pytest.approx(log_det, rel=1e-6, abs=1e-8)
            assert count == (m.channel == c).sum()
            white = whitened(rows, m, hypotheses, np.array([k, k]))
            own = white[m.channel == c]
            assert own.T @ own == pytest.approx(gram, rel=1e-6)


def test_long_series_are_filtered_piece_by_piece(measurements, monkeypatch):
    rows = np.random.default_rng(2).standard_normal((len(measurements), 2))
    hypotheses = Hypotheses.of(measurements)
    fold = measurements.trial
    whole = grams(rows, measurements, hypotheses, fold)
    monkeypatch.setattr(
        "sbi_active.criticism.identification.errors.NUMBERS", 4 * len(hypotheses)
    )
    for one, other in zip(
        whole, grams(rows, measurements, hypotheses, fold), strict=True
    ):
        assert one.gram == pytest.approx(other.gram)
        assert one.log_det == pytest.approx(other.log_det)
