"""Effects hidden in public models: how large they are, and what the table counts."""

from importlib.util import find_spec

import numpy as np
import pandas as pd
import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from benchmarks.__main__ import main as run
from benchmarks.robots.hidden import (
    EXCESS,
    NUM_READINGS,
    NUM_TRIALS,
    Truth,
    hidden_effect,
    planned,
    summary,
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


def test_what_a_parameter_does_has_no_excess(servo):
    truth, effects = servo
    theta = 0.5 * (truth.low + truth.high).numpy()
    gain = next(e for e in effects if e.name == "servo gain")
    null = gain.null_phi(1)[0]
    assert truth.excess(theta, gain, null) < 1e-6


def test_the_table_counts_stated_groups_and_clean_sets(tmp_path, capsys):
    rows = pd.DataFrame(
        {
            "robot": ["a", "a", "a", "a"],
            "kind": ["hidden", "hidden", "clean", "clean"],
            "seed": [2000, 2001, 2000, 2001],
            "effect": ["lag", "gain", "none", "none"],
            "library": [30] * 4,
            "verdict": ["delay", "bias", "none", "gain"],
            "alarm": [1, 1, 0, 1],
            "p_effect": [0.4, 0.0, 0.0, 0.0],
            "right": [1, 0, 1, 0],
            "simulated_trials": [10, 20, 30, 40],
            "cpu_seconds": [1, 2, 3, 4],
        }
    )
    lines = [*summary(rows)]
    assert lines[2].split(" | ")[1:7] == ["30", "0/2", "1/2", "1/2", "1/2", "1/2"]
    out = tmp_path / "hidden.csv"
    rows.assign(seed=[0, 1, 2, 3]).to_csv(out, index=False)  # tuned on
    run(["robots.hidden", "--summary", "--out", str(out)])
    assert "| a |" not in capsys.readouterr().out


@pytest.mark.slow
def test_the_servo_tells_what_it_lacks(tmp_path, capsys):
    out = tmp_path / "hidden.csv"
    run(["robots.hidden", "--robots", "servo", "--seeds", "0", "1", "--out", str(out)])
    rows = pd.read_csv(out)
    assert rows.right.all()
    assert rows.simulated_trials.max() < 15_000
    run(["robots.hidden", "--robots", "servo", "--seeds", "0", "1", "--out", str(out)])
    assert len(pd.read_csv(out)) == 2
