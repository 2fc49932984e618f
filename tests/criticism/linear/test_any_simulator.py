"""Linear models of simulators that are random, jump, or have heavy tails."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Uniform

from sbi_active import GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet
from tests.criticism.steps.linear_world import (
    ACTION,
    NOISE,
    PRIOR,
    effect,
    judged,
    line,
    log_evidence,
    measured,
    rivals,
)

BARE, CURVE = ModelKey(), ModelKey(("curve",))


@pytest.mark.parametrize("size", [0.0, 0.27])
def test_a_random_simulator_has_the_evidence_of_its_own_deviation(size):
    def draw(theta, action):
        return line(theta, action) + NOISE * torch.randn(len(theta), 1).to(theta)

    x = measured(curve=size)
    found = judged(rivals(x, model=SimulatorModel(draw)))
    gain = np.diff([found.states.log_evidence(key) for key in (BARE, CURVE)])
    expected = log_evidence(x, ("curve",)) - log_evidence(x)
    # Of 32 draws a deviation has an error of an eighth, and a residual as well.
    assert gain == pytest.approx(expected, abs=1.0, rel=0.3)
    assert found.detection.alarm == (size > 0)


def test_a_deviation_that_is_a_parameter_is_found():
    """Where only the size of the scatter is unknown, it is what the trials show."""

    def draw(theta, action):
        size = NOISE * torch.exp(theta[:, 2:])
        return line(theta, action) + size * torch.randn(len(theta), 1).to(theta)

    prior = Independent(Uniform(-2 * torch.ones(3), 2 * torch.ones(3)), 1)
    action = ACTION.repeat(4, 1)
    noise = torch.randn(48, 1, generator=torch.Generator().manual_seed(1))
    trials = Trials(action, 0.3 + 0.8 * action + 2.5 * NOISE * noise)
    some = RivalSet(SimulatorModel(draw), prior, trials, [], seed=0)
    found = judged(some)
    assert not found.detection.alarm
    mixture = found.states.mixture(BARE)
    z = some.rival(BARE).coordinates.to_z(mixture.mean[None])[0]
    # The log of a deviation from n numbers has an error of one in sqrt(2 n), a tenth.
    assert z[2] == pytest.approx(np.log(2.5), abs=0.4)
    scale = found.search.model(BARE).scale
    unit = found.search.unit
    assert np.median(unit * scale) == pytest.approx(2.5 * NOISE, rel=0.35)


@pytest.mark.parametrize("size", [0.0, 0.33])
def test_heavy_tails_have_the_bayes_factor_of_importance_sampling(size):
    x = measured(curve=size)
    x[4] += 1.0
    some = rivals(x, model=SimulatorModel(line, noise=StudentTNoise(NOISE, 3.0)))
    found = judged(some)
    linear = np.diff([found.states.log_evidence(key) for key in (BARE, CURVE)])
    sampled = np.diff([some.fit(key).evidence.log_evidence for key in (BARE, CURVE)])
    # Three widths of the effect's prior, of which one was declared.
    assert linear == pytest.approx(sampled, abs=1.5, rel=0.15)
    weight = 1 / found.search.model(CURVE).scale
    assert weight.argmin() == 4


def test_jumps_count_as_noise_and_an_effect_beside_them_is_named():
    def rounded(x):
        return torch.round(x / 0.4) * 0.4

    noise = GaussianNoise(0.05)
    model = SimulatorModel(lambda *given: rounded(line(*given)), noise=noise)
    trials = Trials(ACTION, rounded(measured(wave=1.5)))
    effects = [effect("kink"), effect("wave")]
    loop = Criticism(model, PRIOR, trials, effects=effects)
    assert not loop.rivals.is_smooth
    assert loop.trace().verdict == "wave"
    assert loop.rivals.simulator.num_simulations < 50_000 * 12
