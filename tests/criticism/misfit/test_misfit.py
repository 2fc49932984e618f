"""The closed loop where every model misses by more than the sensor's error."""

import pytest
import torch

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Trials, close_loop
from sbi_active.simulation import AutocorrelatedNoise
from tests.criticism.misfit.oscillator import (
    ACTION,
    EFFECTS,
    MODEL,
    PRIOR,
    SENSOR,
    trials,
)

HIDDEN, LAG = 0.6, 0.3


def loop(own, effects=EFFECTS, model=MODEL, **options):
    return Criticism(model, PRIOR, own, effects=effects, seed=0, **options)


@pytest.fixture(scope="module")
def named():
    """Trials with lag, beside a force that nobody declared."""
    return loop(trials(lag=LAG, hidden=HIDDEN))


def test_the_cause_is_named_beside_what_nobody_declared(named):
    tracing = named.trace()
    assert tracing.verdict == "lag"
    assert tracing.misfit.support["lag"].inclusion > 0.9
    assert tracing.misfit.support["lag"].better > 0.9
    bare, own = tracing.misfit.of("none"), tracing.misfit.of(tracing.model)
    assert own.left_out[0] < 0.5 * bare.left_out[0]
    assert own.remains < 0.5
    assert own.left_out[0] > 1.5 * SENSOR  # the hidden force is there
    assert not tracing.misfit.passes
    assert named.set_aside == ()  # no trial errs far more than the others


def test_without_the_effect_in_the_library_nothing_takes_its_place(named):
    found = loop(trials(lag=LAG, hidden=HIDDEN), EFFECTS[:2]).trace()
    assert found.verdict == "unexplained"
    assert found.misfit.named == ()


@pytest.mark.parametrize("effects", [{}, {"friction": 0.2}])
def test_a_model_that_fits_to_the_sensor_needs_none_of_it(effects):
    found = loop(trials(**effects))
    assert found.misfit() is None
    assert found.trace().verdict == (" + ".join(effects) or "none")


def test_one_trial_with_a_gross_error_is_no_misfit():
    own = trials()
    own.x[3] += 20 * SENSOR
    found = loop(own)
    assert found.misfit() is None
    assert found.trace().verdict == "outlier"


def test_the_order_of_effects_and_trials_does_not_matter(named):
    own = trials(lag=LAG, hidden=HIDDEN)
    turned = loop(own.select([*range(7, -1, -1)]), EFFECTS[::-1]).trace()
    same = named.trace()
    assert {*turned.chosen} == {*same.chosen}
    assert {*turned.misfit.named} == {*same.misfit.named}
    for name, own in same.misfit.support.items():
        remains = turned.misfit.support[name].remains
        assert remains == pytest.approx(own.remains, abs=0.05)


def test_held_out_trials_are_scored_for_every_admitted_model():
    action = torch.cat([ACTION, torch.tensor([[0.8], [1.7]], dtype=torch.float64)])
    every = trials(action=action, lag=LAG, hidden=HIDDEN)
    own = Trials(
        every.action,
        every.x,
        sample_times=every.sample_times,
        role=["fit"] * 8 + ["held out"] * 2,
    )
    report = close_loop(MODEL, PRIOR, own, effects=EFFECTS, seed=0)
    bare = report.tracing.misfit.of("none").held_out
    after = report.tracing.misfit.of(report.tracing.model).held_out
    assert after[0] < 0.6 * bare[0]
    assert "on held-out trials from" in " ".join(str(report).split())
    # Both by the best fit, whose parameters the evidence has.
    rmse = report.evaluation.table.set_index("metric").loc["rmse"]
    assert rmse["before"] == pytest.approx(bare[0], rel=1e-6)
    theta = torch.from_numpy(report.tracing.evidences["none"].best)[None]
    x = MODEL.fn(theta.expand(2, -1), action[8:]).double()
    error = (x - every.x[8:]).square().mean().sqrt()
    assert float(error) == pytest.approx(bare[0], rel=1e-4)


def test_the_sensor_has_an_error_in_each_channel():
    """The lag is that of the first sensor, in its own unit."""
    units = torch.tensor([1.0, 100.0], dtype=torch.float64)

    def fn(theta, action, *, lag=0.0):
        x = MODEL.fn(theta, action, lag=lag)
        return torch.stack([x, MODEL.fn(theta, action)], -1) * units

    noise = AutocorrelatedNoise(
        SENSOR * units, 1e-3, measurement_sd=(SENSOR * units).tolist()
    )
    model = SimulatorModel(
        fn, noise=noise, batched=True, sample_times=MODEL.sample_times
    )
    one, other = trials(lag=LAG, hidden=HIDDEN).x, trials(seed=1, hidden=HIDDEN).x
    own = Trials(
        ACTION, torch.stack([one, 100 * other], -1), sample_times=MODEL.sample_times
    )
    found = loop(own, [EFFECTS[2]], model).trace()
    assert found.misfit.sensor == pytest.approx([SENSOR, 100 * SENSOR])
    bare, after = (found.misfit.of(name).left_out for name in ("none", "lag"))
    assert after[0] < 0.7 * bare[0]
    assert 100 * SENSOR < after[1] < bare[1]
