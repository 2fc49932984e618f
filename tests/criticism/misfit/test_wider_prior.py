"""Parameters at bounds of the prior."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.misfit.contrary import beyond_bounds
from sbi_active.criticism.results import NONE, UNEXPLAINED
from tests.criticism.block import DRAG, GAIN, ROLE, SENSOR, SPEEDS, friction, slid, stop

TIMES = torch.linspace(0.1, 1.0, 10)


def slide(theta, action, **effects):
    """Return the share of the way that is covered at some times."""
    return stop(theta, action, **effects) * (1 - torch.exp(-3 * TIMES))


def criticism(prior, *, effect=GAIN, fn=stop, drag=0.0):
    times = TIMES if fn is slide else None
    given = {"parameter_names": ["friction"], "sample_times": times}
    model = SimulatorModel(fn, noise=SENSOR, **given)
    trials = Trials(SPEEDS, slid(drag, fn), role=ROLE, sample_times=times)
    return Criticism(model, prior, trials, effects=[effect], seed=0)


def beyond(loop, tracing):
    loop.trace()
    return beyond_bounds(loop._verdict, loop.rivals, tracing)


def codes(report):
    return {w.code for w in report.warnings}


@pytest.mark.parametrize("fn", [stop, slide])
def test_an_effect_that_a_wider_prior_makes_up_for_is_not_named(fn):
    """A prior that begins at .5, where friction is .4."""
    report = criticism(friction(0.5), fn=fn).report(plan=False)
    assert report.tracing.chosen == ()
    assert report.verdict == UNEXPLAINED
    assert report.tracing.instead_of == "gain"
    bounds = report.tracing.bounds
    found = bounds.parameters[0]
    assert (found.name, found.model, found.side) == ("friction", NONE, "lower")
    assert found.bound == pytest.approx(0.5)
    assert found.beyond == pytest.approx(0.4, abs=0.005)
    assert bounds.p_value > 0.01
    assert "SA103" in codes(report)
    assert "SA518" not in codes(report)  # it is explained


def test_a_cause_that_no_bound_makes_up_for_stays_named():
    report = criticism(friction(0.1, 0.42), effect=DRAG, drag=0.3).report(plan=False)
    assert report.verdict == "drag"
    assert report.tracing.bounds.replaces == ""
    (found,) = report.tracing.bounds.parameters
    assert (found.model, found.side) == (NONE, "upper")
    assert found.beyond > 0.42
    assert "SA103" in codes(report)


def test_a_narrow_prior_without_bounds_names_nothing_either():
    tight = Independent(Normal(torch.full((1,), 0.5), 0.01), 1)
    tracing = criticism(tight).report(plan=False).tracing
    assert tracing.chosen == ()
    assert tracing.verdict in (NONE, UNEXPLAINED)


def test_a_bound_of_phi_is_told_and_its_null_is_none():
    prior = BoxUniform(torch.zeros(1), torch.full((1,), 0.1))
    strong = Effect.keyword("drag", prior=prior)
    loop = criticism(friction(0.1), effect=strong, drag=0.3)
    assert loop.trace().chosen == ("drag",)
    tracing = beyond(loop, replace(loop.trace(), chosen=("drag",)))
    # Asked first of all, it has the posteriors as well.
    assert (
        criticism(friction(0.1), effect=strong, drag=0.3).judged(None).bounds.parameters
    )
    (found,) = [p for p in tracing.bounds.parameters if p.name == "drag"]
    assert (found.model, found.side) == ("drag", "upper")
    assert found.beyond > 0.15
    weak = criticism(friction(0.1), effect=Effect.keyword("drag", prior=prior))
    told = beyond(weak, replace(weak.trace(), chosen=("drag",)))
    assert told.bounds.parameters == ()


def test_a_simulator_that_refuses_what_is_beyond_is_asked_no_more():
    def refusing(theta, action, **effects):
        if (theta < 0.5).any():
            raise ValueError("expected friction of at least 0.5")
        return stop(theta, action, **effects)

    loop = criticism(friction(0.5))
    loop.trace()
    loop.rivals.simulator.model.base.fn = refusing
    found = beyond(loop, loop.trace())
    (only,) = found.bounds.parameters
    assert np.isnan(only.beyond)
    assert np.isnan(found.bounds.p_value)


@pytest.mark.parametrize(("low", "is_said"), [(0.403, True), (0.1, False)])
def test_a_bare_model_that_explains_at_its_bound_says_so(low, is_said):
    report = criticism(friction(low)).report(plan=False)
    assert report.verdict == NONE
    assert (
        ("SA103" in codes(report)) == is_said == bool(report.tracing.bounds.parameters)
    )
