"""The evidence under a residual process, against dense Gaussian integrals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.special import softmax
from scipy.stats import multivariate_normal, norm

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.left_out import leave_out
from sbi_active.criticism.linear.mixture import WIDTHS, integrated
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import (
    Filter,
    Filters,
    Processes,
    time_scales,
    white_variance,
)
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import LOG_2PI, NoiseCell, NoiseGrid

NUM, SAMPLES = 7, 5
KERNELS = (
    lambda d: np.exp(-d),
    lambda d: (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d),
)


def linear_model(residual, jacobian, **changes) -> LinearModel:
    """Return a model whose priors are wide and unbounded, but for changes."""
    num, dim = jacobian.shape
    parts = {
        "key": ModelKey(),
        "u": np.zeros(dim),
        "center": np.zeros(dim),
        "sd": np.full(dim, 1e3),
        "scaled": np.zeros(dim, bool),
        "low": np.full(dim, -np.inf),
        "high": np.full(dim, np.inf),
        "trial_of": np.full(dim, -1),
        "scale": np.ones(num),
        "offset": np.zeros(num),
    }
    given = {"residual": residual, "jacobian": jacobian, "num": num}
    return LinearModel(**(parts | given | changes))


def problem(*, low=-np.inf, ragged=False):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(NUM, SAMPLES))
    if ragged:
        x[1, 3:] = np.nan
    trials = Trials(np.arange(NUM) + 0.0, x, sample_times=np.arange(SAMPLES) * 0.1)
    m = Measurements.of(trials)
    jacobian = rng.normal(size=(len(m), 2))
    model = linear_model(
        2 * rng.normal(size=len(m)),
        jacobian,
        u=np.array([0.3, 0.4]),
        center=np.array([0.1, 0.0]),
        sd=np.array([1.5, 0.8]),
        scaled=np.array([False, True]),
        low=np.array([-np.inf, low]),
    )
    return model, errors_of(m)


def errors_of(m, varying=None):
    unit = np.full(len(m), 0.5)
    noise = NoiseGrid([NoiseCell.of(m, sd=unit)])
    return Errors(m, unit, noise, largest=2.0, varying=varying)


def dense(model, covariances, sds):
    """Return log evidences, means and covariances of u under dense errors and priors.

    For each covariance of the errors, shape (N, N), and each deviation of the prior.
    """
    rows, found = about_zero(model), []
    design, off = rows[:, 1:], rows[:, 0] - rows[:, 1:] @ model.center
    for noise in covariances:
        for sd in sds:
            prior = np.diag(sd**2)
            whole = noise + design @ prior @ design.T
            gain = prior @ design.T @ np.linalg.inv(whole)
            log_p = multivariate_normal(cov=whole).logpdf(off)
            cov = prior - gain @ design @ prior
            found.append((log_p, model.center + gain @ off, cov))
    return [np.array(part) for part in zip(*found, strict=True)]


def log_mean(logs):
    return np.logaddexp.reduce(logs) - np.log(len(logs))


def both_of(errors, model, use=None):
    """Posteriors with the sensor's error, and beside a process."""
    grams = errors.grams(model)
    return [errors.mixture(model, grams, use, beside=b) for b in (False, True)]


def about_zero(model):
    """Residual at u = 0 and minus its derivatives, shape (N, 1 + d)."""
    at_zero = model.residual - model.jacobian @ model.u
    return np.concatenate([at_zero[:, None], -model.jacobian], 1)


def kernel(m, shape, tau):
    apart = np.abs(m.time[:, None] - m.time) / tau
    return shape(apart) * (m.trial[:, None] == m.trial)


@pytest.mark.parametrize("ragged", [False, True])
def test_the_evidence_is_that_of_the_dense_integral(ragged):
    model, errors = problem(ragged=ragged)
    m, widths = errors.measurements, [model.widened(width) for width in WIDTHS]
    found = both_of(errors, model)
    eye = np.eye(len(m))
    kernels = [kernel(m, shape, tau) for shape in KERNELS for tau in errors.times]
    covariances = [eye + size**2 * k for k in kernels for size in errors.sizes]
    logs, means, _ = dense(model, covariances, widths)
    assert found[1].log_evidence == pytest.approx(log_mean(logs))
    assert found[1].mean == pytest.approx(softmax(logs) @ means)
    alone = dense(model, [eye], widths)[0]
    assert found[0].log_evidence == pytest.approx(log_mean(alone))


def test_a_parameter_that_differs_from_trial_to_trial_is_a_dense_integral_too():
    model, plain = problem()
    m, widths = plain.measurements, [model.widened(width) for width in WIDTHS]
    varying = np.stack([3 * model.jacobian[:, 0], np.zeros(len(m))], 1)
    errors = errors_of(m, varying)
    found, without = both_of(errors, model), both_of(plain, model)
    j = model.jacobian[:, 0] / np.sqrt(np.mean(model.jacobian[:, 0] ** 2))
    same = m.trial[:, None] == m.trial
    covariances = [
        np.eye(len(m)) + size**2 * np.outer(column, column) * same
        for column in (j, 0 * j)
        for size in errors.sizes[::2]
    ]
    varies = log_mean(dense(model, covariances, widths)[0])
    both = log_mean([without[1].log_evidence, varies])
    assert found[1].log_evidence == pytest.approx(both)
    assert errors.process(found[1]) == pytest.approx(plain.process(without[1]))
    use = np.arange(errors.num_folds) != 3
    part, without = both_of(errors, model, use), both_of(plain, model, use)
    assert part[0].log_evidence == without[0].log_evidence


def test_a_bound_of_phi_counts_by_the_posterior_within_it():
    free, errors = problem()
    bounded, _ = problem(low=0.0)
    grams = errors.grams(free)
    use = np.ones(errors.num_folds, bool)
    gram = grams.gram[-1:, use].sum(1)
    log_z, mean, cov = (part[:, 0] for part in integrated(gram, free, [1.0]))
    within = integrated(gram, bounded, [1.0])[0][:, 0]
    inside = norm.logsf(0.0, mean[0, 1], np.sqrt(cov[0, 1, 1]))
    assert within[0] - log_z[0] == pytest.approx(inside - np.log(0.5))


def test_left_out_errors_are_those_of_refits():
    model, errors = problem()
    left = leave_out(model, errors)
    rows, fold = about_zero(model), errors.fold
    scale = max(model.rms, 1.0)
    prior = np.diag(1 / model.widened(3.0))
    for k in range(errors.num_folds):
        rest = fold != k
        a = np.concatenate([rows[rest, 1:] / scale, prior])
        b = np.concatenate([rows[rest, 0] / scale, prior @ model.center])
        fit = np.linalg.lstsq(a, b, rcond=None)[0]
        error = rows[~rest, 0] - rows[~rest, 1:] @ fit
        assert left.refits[k] == pytest.approx(fit)
        assert left.square[k] == pytest.approx(np.mean(error**2))


@pytest.mark.parametrize("far", [1.0, 1e6])
def test_evidence_keeps_its_digits_however_far_the_prior_is(far):
    """Residuals at the prior's center are a million sensor deviations."""
    model, errors = problem()
    column = far * np.linspace(1, 2, len(model.residual))
    jacobian = np.column_stack([model.jacobian, column])
    away = {"u": np.append(model.u, 1.0), "center": np.append(model.center, 0.0)}
    away |= {"sd": np.append(model.sd, 1.0), "scaled": np.append(model.scaled, False)}
    away = linear_model(model.residual, jacobian, **away)
    logs = []
    for width in WIDTHS:
        sd = away.widened(width)
        values = np.linalg.svd(jacobian * sd, compute_uv=False)
        a = np.concatenate([jacobian, np.diag(1 / sd)])
        b = np.concatenate([away.residual, (away.u - away.center) / sd])
        left = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
        log_det = np.log1p(values**2).sum() + len(column) * LOG_2PI
        logs.append(-0.5 * (left @ left + log_det))
    found = both_of(errors, away)[0].log_evidence
    assert found == pytest.approx(log_mean(logs), abs=1e-5)


# Refits without a part of the trials stay within bounds, and are the best there


@pytest.fixture
def line():
    """A line through trials of two numbers, the last of which is far away."""
    rng = np.random.default_rng(1)
    x = np.append(rng.normal(size=14), [30.0, 30.0])
    model = linear_model(2 * rng.normal(size=16), np.stack([np.ones(16), x], 1))
    fold = np.repeat(np.arange(8), 2)
    errors = SimpleNamespace(fold=fold, num_folds=8, is_scored=np.ones(16, bool))
    return model, errors


def test_a_trial_that_is_extrapolated_to_counts_in_units_of_what_is_expected(line):
    """Against the plain covariance of a prediction."""
    model, errors = line
    left = leave_out(model, errors)
    assert model.rms > 1
    for j in range(8):
        at = errors.fold == j
        own, rest = model.jacobian[at], model.jacobian[~at]
        cov = np.linalg.inv(rest.T @ rest / model.rms**2 + np.eye(2) / 1e6)
        expected = np.eye(2) + own @ cov @ own.T / model.rms**2
        error = left.error[at]
        square = error @ np.linalg.solve(expected, error) / 2
        assert left.standard[j] == pytest.approx(square, rel=1e-6)
    assert left.standard[-1] < 0.3 * left.square[-1]
    assert (left.standard <= left.square).all()


def test_weights_are_those_of_least_squares(line):
    model, errors = line
    weight = 1.5 + np.sin(errors.fold)
    root = np.sqrt(weight)
    same = replace(
        model, residual=root * model.residual, jacobian=root[:, None] * model.jacobian
    )
    found, plain = leave_out(model, errors, weight=weight), leave_out(same, errors)
    assert found.standard == pytest.approx(plain.standard)
    assert found.refits == pytest.approx(plain.refits)
    assert found.square == pytest.approx(plain.square)


def test_a_coordinate_at_its_bound_is_no_excuse_for_an_error(line):
    """An effect that its bound keeps away leaves errors as they are without it."""
    model, errors = line
    columns = np.column_stack([model.jacobian, -(model.jacobian[:, 1] ** 2)])
    bounds = {"low": np.append(model.low, 0.0), "high": np.append(model.high, 1e-12)}
    wide = linear_model(model.residual, columns, **bounds)
    found = leave_out(wide, errors).standard
    assert found == pytest.approx(leave_out(model, errors).standard, rel=1e-6)


# Whitened rows are those of the covariance that the errors have


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
