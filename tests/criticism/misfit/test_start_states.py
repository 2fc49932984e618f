"""Start states that every trial has anew, beside an effect and an undeclared force."""

import numpy as np
import pytest
import torch
from torch.distributions import HalfNormal, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.predictive import conditioned, predict

SENSOR, NUM, NUM_HELD, SAMPLES = 0.01, 12, 4, 30
TIMES = torch.linspace(0.1, 3.0, SAMPLES, dtype=torch.float64)
PRIOR = Normal(torch.tensor([2.0]), torch.tensor([0.7]))
PRIOR = torch.distributions.Independent(PRIOR, 1)
START = Effect.keyword("start", prior=Normal(0.0, 0.5), scope="trial")
DRAG = Effect.keyword("drag", prior=HalfNormal(1.0))
BIAS = Effect.keyword("bias", prior=Normal(0.0, 0.05))
HIDDEN = 0.08


def level(theta, action, *, start=0.0, drag=0.0, bias=0.0, hidden=0.0):
    """Return x' = -theta x - drag x |x| + action sin 3t from a start, (n, k)."""
    k, u = theta[:, 0].double(), action[:, 0].double()
    x = torch.zeros_like(k) + start
    found, dt = [], 0.05
    for i in range(SAMPLES * 2):
        t = torch.tensor(dt * i, dtype=torch.float64)
        x = x + dt * (-k * x - drag * x * x.abs() + u * torch.sin(3 * t))
        x = x + dt * hidden * torch.cos(5 * t)
        if i % 2:
            found.append(x + bias)
    return torch.stack(found, 1).to(theta.dtype)


MODEL = SimulatorModel(
    level, noise=GaussianNoise(SENSOR), batched=True, sample_times=TIMES
)


def trials(**effects):
    rng = np.random.default_rng(1)
    num = NUM + NUM_HELD
    action = torch.from_numpy(rng.uniform(1, 4, (num, 1)))
    start = torch.from_numpy(rng.normal(0, 0.5, num))
    theta = torch.full((num, 1), 2.3, dtype=torch.float64)
    x = level(theta, action, start=start, **effects)
    x = x + SENSOR * torch.from_numpy(rng.normal(size=x.shape))
    role = ["fit"] * NUM + ["held out"] * NUM_HELD
    return Trials(action, x, sample_times=TIMES, role=role), start


def loop(own, **options):
    return Criticism(MODEL, PRIOR, own, effects=[START, DRAG, BIAS], seed=0, **options)


@pytest.fixture(scope="module")
def found():
    own, start = trials(drag=1.2, hidden=HIDDEN)
    return loop(own, warm_up=0.55), own, start


def test_the_cause_is_found_beside_start_states(found):
    criticism, *_ = found
    assert criticism.trace().verdict == "drag"
    evidence = criticism.trace().evidences["drag"]
    assert evidence.effective_sample_size >= 50
    assert evidence.draws.shape[1] == 2  # theta and drag, no start states


def test_a_held_out_trial_tells_of_its_start_by_its_first_samples(found):
    criticism, own, start = found
    tracing, held = criticism.trace(), own.held_out
    error = tracing.misfit.of(tracing.model).held_out[0]
    blind = loop(own)
    far = blind.trace().misfit.of(blind.trace().model).held_out[0]
    assert error < 0.5 * far
    # What was used to find the start is not scored.
    p = predict(criticism.rivals, held, key=ModelKey(("drag",)))
    assert len(p.measurements) == 4 * (SAMPLES - 6)
    assert {int(i) % SAMPLES for i in p.measurements.position} == {*range(6, SAMPLES)}


def test_start_states_are_those_of_least_squares(found):
    """Drawn given the first samples, against a search over the start alone."""
    criticism, own, start = found
    criticism.trace()
    rivals = criticism.rivals
    fit = rivals.fit(ModelKey(("drag",)))
    simulator = TrialSimulator(rivals.simulator.model, own.held_out)
    rng = np.random.default_rng(0)
    theta, phi = conditioned(rivals, fit, fit.sample.u[:40], simulator, rng)
    grid = torch.linspace(-2, 2, 2001, dtype=torch.float64)
    middle = torch.full((len(grid), 1), float(theta.mean()), dtype=torch.float64)
    for t, drawn in enumerate(phi["start"][..., 0].T.numpy()):
        action = own.held_out.action[t].expand(len(grid), -1)
        x = level(middle, action, start=grid, drag=float(phi["drag"].mean()))
        square = ((x - own.held_out.x[t])[:, :6] ** 2).sum(1)
        best = float(grid[int(square.argmin())])
        assert drawn.mean() == pytest.approx(best, abs=4 * drawn.std() + 0.01)
        assert drawn.std() < 0.1
