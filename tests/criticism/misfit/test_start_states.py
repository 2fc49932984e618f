"""Start states that every trial has anew, beside an effect and an undeclared force."""

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.predictive import conditioned, predict
from tests.criticism.misfit import oscillator

NUM, NUM_HELD, FIRST = 12, 4, 7
START = Effect.keyword("start", prior=Normal(0.0, 0.5), scope="trial")
EFFECTS = [START, *oscillator.EFFECTS[2:]]


def loop(own, **options):
    parts = oscillator.MODEL, oscillator.PRIOR, own
    return Criticism(*parts, effects=EFFECTS, seed=0, **options)


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(1)
    action = torch.from_numpy(rng.uniform(1, 4, (NUM + NUM_HELD, 1)))
    start = torch.from_numpy(rng.normal(0, 0.5, NUM + NUM_HELD))
    every = oscillator.trials(action=action, lag=0.3, hidden=0.3, start=start)
    role = ["fit"] * NUM + ["held out"] * NUM_HELD
    own = Trials(action, every.x, sample_times=oscillator.TIMES, role=role)
    return loop(own, warm_up=1.25), own


def test_the_cause_is_found_beside_start_states(found):
    criticism, _ = found
    assert criticism.trace().verdict == "lag"
    evidence = criticism.trace().evidences["lag"]
    assert evidence.effective_sample_size >= 50
    assert evidence.draws.shape[1] == 3  # theta and lag, no start states


def test_a_held_out_trial_tells_of_its_start_by_its_first_samples(found):
    criticism, own = found
    tracing, held = criticism.trace(), own.held_out
    error = tracing.misfit.of(tracing.model).held_out[0]
    blind = loop(own)
    far = blind.trace().misfit.of(blind.trace().model).held_out[0]
    assert error < 0.5 * far
    # What was used to find the start is not scored.
    p = predict(criticism.rivals, held, key=ModelKey(("lag",)))
    assert len(p.measurements) == NUM_HELD * (20 - FIRST)
    assert {int(i) % 20 for i in p.measurements.position} == {*range(FIRST, 20)}


def test_start_states_are_those_of_least_squares(found):
    """Drawn given the first samples, against a search over the start alone."""
    criticism, own = found
    criticism.trace()
    rivals = criticism.rivals
    fit = rivals.fit(ModelKey(("lag",)))
    simulator = TrialSimulator(rivals.simulator.model, own.held_out)
    rng = np.random.default_rng(0)
    theta, phi = conditioned(rivals, fit, fit.sample.u[:40], simulator, rng)
    grid = torch.linspace(-2, 2, 2001, dtype=torch.float64)
    middle = theta.double().reshape(-1, 2).mean(0).expand(len(grid), -1)
    for t, drawn in enumerate(phi["start"][..., 0].T.numpy()):
        action = own.held_out.action[t].expand(len(grid), -1)
        lag = float(phi["lag"].mean())
        x = oscillator.oscillate(middle, action, start=grid, lag=lag)
        square = ((x - own.held_out.x[t])[:, :FIRST] ** 2).sum(1)
        best = float(grid[int(square.argmin())])
        assert drawn.mean() == pytest.approx(best, abs=4 * drawn.std() + 0.01)
        assert drawn.std() < 0.1
