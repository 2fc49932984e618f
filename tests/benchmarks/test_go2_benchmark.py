"""The Go2's legs: what is read, what is run, and the tables."""

from pathlib import Path

import pytest
import torch

from benchmarks.measured.go2_leg import read_leg, usual_parameters
from sbi_active.mujoco import mjcf_effects

DATA = Path(__file__).parents[2] / "../shared/data/go2_in_air"

needs_data = pytest.mark.skipif(
    not (DATA / "trajectory.csv").is_file(),
    reason=f"needs the files of go2_in_air in {DATA}",
)


@pytest.fixture(scope="module")
def leg():
    return read_leg(DATA, "FL")


@pytest.mark.slow
@needs_data
def test_friction_by_position_follows_the_knee_where_a_constant_one_does_not(leg):
    parameters = usual_parameters(leg)
    robot = leg.robot(parameters, leg.triangles())
    (effect,) = mjcf_effects(robot, include=["FL_calf_joint friction loss by position"])
    # Armature, damping, friction and torque scale of a fit by SciPy.
    theta = [0, 0.014, 0.03, 0.165, 0.181, 0.22, 0.256, 0.169, 0.6, 0.872, 0.795, 0.9]
    bare = [0, 0.014, 0.029, 0.159, 0.18, 0.158, 0.256, 0.166, 0.86, 0.872, 0.794, 0.92]
    with_it = torch.tensor([[*theta, 0.5, 0.0]])
    after = leg.errors(leg.free_run(parameters, [effect], with_it)[0])
    before = leg.errors(leg.free_run(parameters, [], torch.tensor([bare]))[0])
    assert before["fitted"][2] > 7e-3
    assert after["fitted"][2] < 3e-3
    assert after["held out"][2] < 5e-3
