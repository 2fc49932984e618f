"""The evidence under a process across trials, against dense Gaussian integrals."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.misfit.across_trials import AcrossTrials
from sbi_active.criticism.misfit.linear import LinearModel
from sbi_active.criticism.misfit.processes import WIDTHS
from sbi_active.criticism.results import UNEXPLAINED, ModelKey
from sbi_active.criticism.rivals.error_models import NoiseCell

NUM, CHANNELS = 9, 2


def problem(num=NUM, channels=CHANNELS):
    rng = np.random.default_rng(1)
    x = rng.normal(size=(num, channels))
    x[2, 1:] = np.nan  # of a trial with several numbers, one
    m = Measurements.of(Trials(np.arange(num) + 0.0, x))
    model = LinearModel(
        key=ModelKey(("a",)),
        u=np.array([0.3, 0.4]),
        residual=2 * rng.normal(size=len(m)),
        jacobian=rng.normal(size=(len(m), 2)),
        center=np.array([0.1, 0.0]),
        sd=np.array([1.5, 0.8]),
        scaled=np.array([False, True]),
        low=np.full(2, -np.inf),
        high=np.full(2, np.inf),
        own=2,
        trial_of=np.array([-1, -1]),
    )
    unit = np.full(len(m), 0.5)
    errors = AcrossTrials(
        *(m, unit, [NoiseCell.of(m, sd=unit)]),
        largest=2.0,
        action=rng.uniform(size=(num, 2)),
        order=np.linspace(0, 1, num),
        spread=rng.uniform(0.5, 2.0, size=len(m)),
    )
    return model, errors


def dense(model, errors, keep):
    """Log evidence with a process and without, and the mean, by dense integrals."""
    m, rows = errors.measurements, model.rows
    same = m.channel[:, None] == m.channel
    design, off = rows[keep, 1:], rows[keep, 0] - rows[keep, 1:] @ model.center
    logs, alone, means = [], [], []
    for width in WIDTHS:
        prior = np.diag(model.widened(width) ** 2)
        known = np.eye(keep.sum()) + design @ prior @ design.T
        alone.append(multivariate_normal(np.zeros(len(off)), known).logpdf(off))
        for d in errors.spreads:
            for kernel in errors.kernels:
                own = kernel[np.ix_(errors.fold, errors.fold)] * same * np.outer(d, d)
                for size in errors.sizes:
                    cov = known + size**2 * own[np.ix_(keep, keep)]
                    logs.append(
                        multivariate_normal(np.zeros(len(off)), cov).logpdf(off)
                    )
                    gain = prior @ design.T @ np.linalg.inv(cov)
                    means.append(model.center + gain @ off)
    logs, means = np.array(logs), np.array(means)
    p = np.exp(logs - logs.max())
    with_process = np.log(np.mean(p)) + logs.max()
    return with_process, np.log(np.mean(np.exp(alone))), p @ means / p.sum()


@pytest.mark.parametrize("without", [None, 4])
def test_the_evidence_is_that_of_the_dense_integral(without):
    """Trials are not independent: those that do not count are left out of all."""
    model, errors = problem()
    use = None if without is None else np.arange(errors.num_folds) != without
    found = errors.posterior(model, errors.grams(model.rows), use)
    keep = np.ones(len(errors.fold), bool) if use is None else use[errors.fold]
    with_process, alone, mean = dense(model, errors, keep)
    assert found.log_process == pytest.approx(with_process)
    assert found.log_sensor == pytest.approx(alone)
    assert found.mean == pytest.approx(mean)
    assert found.time_scale == np.inf


def test_trials_of_one_number_are_compared_in_groups():
    _, errors = problem(24, 1)
    square = np.arange(24.0)
    square[5] = np.nan
    pieces = errors.pieces(square)
    assert len(pieces) == 8
    assert pieces[0] == pytest.approx(np.mean([0, 8, 16]))
    assert pieces[5] == pytest.approx(np.mean([13, 21]))
    _, errors = problem(8, 4)
    assert errors.pieces(np.arange(8.0)) == pytest.approx(np.arange(8.0))


# The closed loop on numbers without a time axis.

ACTION = torch.linspace(0.2, 2.0, 24, dtype=torch.float64)[:, None]
PRIOR = Independent(Normal(torch.tensor([1.0, 0.0]), torch.tensor([0.5, 0.5])), 1)
SENSOR = 0.01
LIBRARY = [
    Effect.keyword("drag", prior=HalfNormal(0.5)),
    Effect.keyword("lift", prior=Normal(0.0, 0.5)),
]


def reach(theta, action, *, drag=0.0, lift=0.0, hidden=0.0):
    a, b = theta.T.double()
    u = action[:, 0].double()
    x = a * u + b - drag * u**2 + lift * torch.sin(5 * u)
    return (x + hidden * torch.sin(9 * u)).to(theta.dtype)[:, None]


def verdict(library=LIBRARY, **effects):
    theta = torch.tensor([[1.2, 0.3]], dtype=torch.float64).expand(len(ACTION), -1)
    gen = torch.Generator().manual_seed(0)
    x = reach(theta, ACTION, **effects)
    x = x + SENSOR * torch.randn(x.shape, generator=gen, dtype=torch.float64)
    model = SimulatorModel(reach, noise=GaussianNoise(SENSOR), batched=True)
    return Criticism(model, PRIOR, Trials(ACTION, x), effects=library, seed=0)


def test_an_effect_is_named_beside_what_nobody_declared():
    loop = verdict(drag=0.4, hidden=0.03)
    tracing = loop.trace()
    assert tracing.misfit is not None
    assert tracing.verdict == "drag"
    assert tracing.misfit.named == ("drag",)
    assert 0 < tracing.misfit.of("drag").remains < 0.5
    assert not tracing.misfit.passes
    low, high = np.quantile(tracing.evidences["drag"].draws[:, -1], [0.05, 0.95])
    assert low < 0.4 < high
    text = " ".join(str(loop.report()).split())
    assert "time scale" not in text
    assert "residual process of unknown size and length" in text


def test_nothing_is_named_where_nothing_declared_helps():
    tracing = verdict(LIBRARY[:1], hidden=0.1).trace()
    assert tracing.misfit is not None
    assert tracing.verdict == UNEXPLAINED
    assert tracing.chosen == ()


def test_a_model_that_fits_is_judged_by_the_simulator_alone():
    assert verdict(drag=0.4).trace().misfit is None
    assert verdict().trace().verdict == "none"
