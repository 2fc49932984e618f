"""Effects hidden in public models: how large they are, and what the table counts."""

from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from benchmarks.robots.hidden import (
    EXCESS,
    NUM_READINGS,
    NUM_TRIALS,
    Truth,
    hidden_effect,
    planned,
)
from benchmarks.robots.public import PUBLIC
from sbi_active.mujoco import mjcf_effects


@pytest.fixture(scope="module")
def servo():
    robot, measured = planned(PUBLIC["servo"], np.random.default_rng(3))
    trials = measured(np.zeros((NUM_TRIALS, NUM_READINGS, 1)))
    return Truth(robot, trials), mjcf_effects(robot, trials=trials)


def test_a_hidden_effect_shows_and_no_parameter_absorbs_it(servo):
    truth, effects = servo
    theta = 0.5 * (truth.low + truth.high).numpy()
    rng = np.random.default_rng(5)
    effect, phi, excess = hidden_effect(truth, effects, theta, rng)
    assert EXCESS[0] <= excess <= EXCESS[1]
    assert np.isfinite(float(effect.log_prob(phi[None])))
    # Not refitted, the bare model is farther away.
    apart = truth.run(theta[None], effect, phi) - truth.run(theta[None])
    assert (apart**2).sum() >= excess * 0.999
    again = hidden_effect(truth, effects, theta, np.random.default_rng(5))
    assert again[0].name == effect.name
    assert again[2] == excess
