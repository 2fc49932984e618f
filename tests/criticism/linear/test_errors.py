"""The evidence under a residual process, against dense Gaussian integrals."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.left_out import leave_out
from sbi_active.criticism.linear.mixture import WIDTHS, integrated
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.misfit.intervals import shared_process
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import LOG_2PI, NoiseCell, NoiseGrid

NUM, SAMPLES = 7, 5
KERNELS = (
    lambda d: np.exp(-d),
    lambda d: (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d),
)


def problem(*, low=-np.inf, ragged=False, num=NUM, differs=False):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(num, SAMPLES))
    if ragged:
        x[1, 3:] = np.nan
    trials = Trials(np.arange(num) + 0.0, x, sample_times=np.arange(SAMPLES) * 0.1)
    m = Measurements.of(trials)
    jacobian = rng.normal(size=(len(m), 2))
    model = LinearModel(
        key=ModelKey(("a",)),
        u=np.array([0.3, 0.4]),
        residual=2 * rng.normal(size=len(m)),
        jacobian=jacobian,
        center=np.array([0.1, 0.0]),
        sd=np.array([1.5, 0.8]),
        scaled=np.array([False, True]),
        low=np.array([-np.inf, low]),
        high=np.array([np.inf, np.inf]),
        trial_of=np.array([-1, -1]),
        num=len(m),
        scale=np.ones(len(m)),
        offset=np.zeros(len(m)),
    )
    unit = np.full(len(m), 0.5)
    noise = NoiseGrid([NoiseCell.of(m, sd=unit)])
    varying = jacobian if differs else None
    return model, Errors(m, unit, noise, largest=2.0, varying=varying)


def both_of(errors, model, use=None):
    """Posteriors with the sensor's error, and beside a process."""
    grams = errors.grams(model.rows)
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
    m, rows = errors.measurements, about_zero(model)
    found = both_of(errors, model)
    logs, means = [], []
    for shape in KERNELS:
        for tau in errors.times:
            for size in errors.sizes:
                for width in WIDTHS:
                    noise = np.eye(len(m)) + size**2 * kernel(m, shape, tau)
                    prior = np.diag(model.widened(width) ** 2)
                    design = rows[:, 1:]
                    cov = noise + design @ prior @ design.T
                    off = rows[:, 0] - design @ model.center
                    logs.append(multivariate_normal(np.zeros(len(m)), cov).logpdf(off))
                    gain = prior @ design.T @ np.linalg.inv(cov)
                    means.append(model.center + gain @ off)
    logs, means = np.array(logs), np.array(means)
    p = np.exp(logs - logs.max())
    assert found[1].log_evidence == pytest.approx(np.log(np.mean(p)) + logs.max())
    assert found[1].mean == pytest.approx(p @ means / p.sum())
    alone = []
    for width in WIDTHS:
        prior = np.diag(model.widened(width) ** 2)
        cov = np.eye(len(m)) + rows[:, 1:] @ prior @ rows[:, 1:].T
        off = rows[:, 0] - rows[:, 1:] @ model.center
        alone.append(multivariate_normal(np.zeros(len(m)), cov).logpdf(off))
    assert found[0].log_evidence == pytest.approx(np.log(np.mean(np.exp(alone))))


def test_a_parameter_that_differs_from_trial_to_trial_is_a_dense_integral_too():
    model, plain = problem()
    m, rows = plain.measurements, about_zero(model)
    varying = np.stack([3 * model.jacobian[:, 0], np.zeros(len(m))], 1)
    cells = [NoiseCell.of(m, sd=plain.unit)]
    errors = Errors(m, plain.unit, NoiseGrid(cells), largest=2.0, varying=varying)
    found = both_of(errors, model)
    without = both_of(plain, model)
    j = model.jacobian[:, 0] / np.sqrt(np.mean(model.jacobian[:, 0] ** 2))
    logs = []
    for column in (j, 0 * j):
        k = np.outer(column, column) * (m.trial[:, None] == m.trial)
        for size in errors.sizes[::2]:
            for width in WIDTHS:
                prior = np.diag(model.widened(width) ** 2)
                design = rows[:, 1:]
                cov = np.eye(len(m)) + size**2 * k + design @ prior @ design.T
                off = rows[:, 0] - design @ model.center
                logs.append(multivariate_normal(np.zeros(len(m)), cov).logpdf(off))
    varies = np.log(np.mean(np.exp(np.array(logs) - max(logs)))) + max(logs)
    both = np.logaddexp(without[1].log_evidence, varies) - np.log(2)
    assert found[1].log_evidence == pytest.approx(both)
    own, other = errors.process(found[1]), plain.process(without[1])
    assert own == pytest.approx(other)
    use = np.arange(errors.num_folds) != 3
    part, without = both_of(errors, model, use), both_of(plain, model, use)
    assert part[0].log_evidence == without[0].log_evidence


def test_a_bound_of_phi_counts_by_the_posterior_within_it():
    free, errors = problem()
    bounded, _ = problem(low=0.0)
    grams = errors.grams(free.rows)
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


@pytest.mark.parametrize("differs", [False, True])
def test_an_error_that_trials_share_is_that_of_the_dense_integral(differs):
    model, errors = problem(differs=differs)
    m, rows = errors.measurements, about_zero(model)
    action = np.linspace(-1, 1, NUM)[:, None]
    mean, cov = shared_process(model, errors, action)
    scaled = action / action.std()
    square = (scaled - scaled.T) ** 2
    between = [np.eye(NUM)]
    for share in (0.5, 0.9):
        for length in (0.7, 1e3):
            shared = share * np.exp(-0.5 * square / length**2)
            between.append(shared + (1 - share) * np.eye(NUM))
    apart = np.abs(m.time[:, None] - m.time)
    along = [shape(apart / tau) for shape in KERNELS for tau in errors.times]
    columns = (model.jacobian / np.sqrt((model.jacobian**2).mean(0))).T
    logs, means, covs = [], [], []
    for kernels in (along, [np.outer(j, j) for j in columns])[: 1 + differs]:
        each = len(kernels) * len(between) * len(errors.sizes[::2])
        for inside in kernels:
            for a in between:
                for size, width in product(errors.sizes[::2], WIDTHS):
                    k = inside * a[m.trial[:, None], m.trial]
                    noise = np.eye(len(m)) + size**2 * k
                    prior = np.diag(model.widened(width) ** 2)
                    design = rows[:, 1:]
                    whole = noise + design @ prior @ design.T
                    off = rows[:, 0] - design @ model.center
                    log_p = multivariate_normal(cov=whole).logpdf(off)
                    logs.append(log_p - np.log(each))
                    gain = prior @ design.T @ np.linalg.inv(whole)
                    means.append(model.center + gain @ off)
                    covs.append(prior - gain @ design @ prior)
    p = np.exp(np.array(logs) - max(logs))
    p, means = p / p.sum(), np.array(means)
    assert mean == pytest.approx(p @ means, rel=1e-6)
    off = means - p @ means
    exact = np.einsum("h,hij->ij", p, np.array(covs)) + (p[:, None] * off).T @ off
    assert cov == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("far", [1.0, 1e6])
def test_evidence_keeps_its_digits_however_far_the_prior_is(far):
    """Residuals at the prior's center are a million sensor deviations."""
    model, errors = problem()
    column = far * np.linspace(1, 2, len(model.residual))[:, None]
    away = replace(
        model,
        u=np.append(model.u, 1.0),
        jacobian=np.concatenate([model.jacobian, column], 1),
        center=np.append(model.center, 0.0),
        sd=np.append(model.sd, 1.0),
        scaled=np.append(model.scaled, False),
        low=np.append(model.low, -np.inf),
        high=np.append(model.high, np.inf),
        trial_of=np.append(model.trial_of, -1),
    )
    found = both_of(errors, away)[0].log_evidence
    logs = []
    for width in WIDTHS:
        jacobian, sd = away.jacobian, away.widened(width)
        values = np.linalg.svd(jacobian * sd, compute_uv=False)
        a = np.concatenate([jacobian, np.diag(1 / sd)])
        b = np.concatenate([away.residual, (away.u - away.center) / sd])
        left = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
        log_det = np.log1p(values**2).sum()
        logs.append(-0.5 * (left @ left + log_det + len(b[: len(column)]) * LOG_2PI))
    exact = np.logaddexp.reduce(logs) - np.log(len(logs))
    assert found == pytest.approx(exact, abs=1e-5)
