"""Trajectories that are sampled too densely for what the simulator gets wrong."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import AutocorrelatedNoise, DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Trials
from tests.criticism.report.reports import flat
from tests.effects import on_outcomes

SENSOR = 0.002
TIMES = torch.arange(1, 241) * 0.02
PRIOR = BoxUniform(0.2 * torch.ones(1), 2 * torch.ones(1))
ACTIONS = DiscreteActions(torch.linspace(0.5, 2.0, 6))
BIAS = on_outcomes("bias", lambda x, phi, action, context: x + phi, sd=0.1)
CALLS = []


def swing(theta, action):
    CALLS.append(len(theta))
    return theta * action * (1.3 * TIMES).sin()


def loop(wrong, *, measurement_sd=SENSOR, role=None, **options):
    """Compare a swing with trials that differ by something smooth of some size."""
    noise = AutocorrelatedNoise.unknown(
        sd=(0.5 * SENSOR, 0.5),
        correlation_time=(0.01, 5.0),
        num_sds=20,
        num_times=6,
        measurement_sd=measurement_sd,
    )
    model = SimulatorModel(swing, noise=noise, sample_times=TIMES)
    gen = torch.Generator().manual_seed(0)
    action = ACTIONS.values
    phase = 6 * torch.rand(len(action), 1, generator=gen)
    x = swing(torch.tensor([[0.8]]), action) + wrong * (2.1 * TIMES + phase).sin()
    x = x + SENSOR * torch.randn(x.shape, generator=gen)
    trials = Trials(action, x, sample_times=TIMES, role=role)
    options = {"effects": [BIAS], "actions": ACTIONS, **options}
    return Criticism(model, PRIOR, trials, **options)


def test_what_is_smooth_is_thinned_with_a_sentence():
    role = ["fit"] * 5 + ["held out"]
    criticism = loop(0.05, role=role)
    every = criticism.sampling.every
    assert 4 <= every <= 30
    assert criticism.sampling.before > 0.5
    kept = criticism.trials.mask
    assert kept[:, every - 1 :: every].all()
    assert int(kept.sum()) == 6 * (240 // every)
    assert len(criticism.rivals.measurements) == 5 * (240 // every)
    report = criticism.report()
    assert f"of 50 samples a second one in {every} is used" in flat(report)
    assert len([w for w in report.warnings if "samples a second" in w]) == 1
    # The next trial would be thinned as well.
    x, _ = criticism.trials.template()
    assert int(x.isfinite().sum()) == 240 // every
    drawn = report.residuals.refitted[0]
    assert np.isfinite(drawn).sum() == 240 // every


@pytest.mark.slow
def test_what_the_sensor_alone_gets_wrong_is_kept():
    criticism = loop(0.0)
    assert criticism.sampling.every == 1
    assert criticism.trials.mask.all()
    assert "samples a second" not in flat(criticism.report(evaluate=False, plan=False))


@pytest.mark.parametrize("options", [{"thin": False}, {"measurement_sd": None}])
def test_nobody_looks_where_it_is_not_asked_for_or_no_sensor_is_declared(options):
    CALLS.clear()
    criticism = loop(0.05, **options)
    without = sum(CALLS)
    assert criticism.sampling is None
    assert criticism.trials.mask.all()
    CALLS.clear()
    loop(0.05)
    assert sum(CALLS) > without
