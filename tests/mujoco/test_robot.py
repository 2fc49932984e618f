"""Robots from their MJCF: what they simulate, and what is refused."""

import pickle

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.robots.models import ARM, PENDULUM, SPRING_MASS, TIMES
from sbi_active import BoxActions, Campaign, CampaignOptions
from sbi_active.actions.signals import SignalActions
from sbi_active.actions.waveforms import step
from sbi_active.criticism import Trials
from sbi_active.mujoco import from_mjcf
from sbi_active.mujoco.models.spec import Source
from sbi_active.mujoco.robot import Robot
from sbi_active.simulation import Outcome, simulate
from tests.campaign.problem import REFINEMENT
from tests.mujoco.machines import stepped

RELEASE = BoxActions([-1.5], [1.5], names=["hinge"])


def pendulum(text: str = PENDULUM, **options) -> Robot:
    given = {
        "parameters": {"hinge.damping": (0.0, 0.1), "bob.mass": (0.5, 2.0)},
        "sensors": ["hinge"],
        "actions": RELEASE,
        "times": TIMES,
        "noise": 0.01,
    }
    return from_mjcf(text, **{**given, **options})


def test_a_pendulum_moves_as_one_stepped_by_hand():
    robot = pendulum()
    theta = torch.tensor([[0.02, 1.5], [0.09, 0.6]], dtype=torch.float64)
    action = torch.tensor([[0.4], [-1.2]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action)
    for row in range(2):
        damping, mass = theta[row].tolist()
        text = PENDULUM.replace('damping="0.03"', f'damping="{damping!r}"')
        text = text.replace('mass="1"', f'mass="{mass!r}"')
        angles = stepped(text, 151, qpos=action[row, 0])[10::10, 0]
        assert x[row].numpy() == pytest.approx(angles, abs=1e-12)


def test_rows_do_not_depend_on_batches_or_workers():
    robot = pendulum()
    theta, action = robot.prior.sample((30,)), RELEASE.sample((30,))
    x = simulate(robot.simulator, theta, action, seed=0).x
    for options in ({"batch_size": 7}, {"num_workers": 2, "batch_size": 11}):
        same = simulate(robot.simulator, theta, action, seed=0, **options).x
        assert (same == x).all()
    again = robot.simulator.mean(theta, action)
    one = torch.cat([robot.simulator.mean(t[None], a[None])
                     for t, a in zip(theta[:9], action[:9], strict=True)])  # fmt: skip
    assert (one == again[:9]).all()


def length(spec, value):
    spec.body("bob").first_geom().fromto = [0, 0, 0, 0, 0, -value]


def armature(spec, value):
    spec.joint("hinge").armature = value


#: Edits, the same in the text, and whether one is affine.
EDITS = [
    (armature, 'damping="0.03"', 'damping="0.03" armature="{}"', True),
    (length, "0 0 -.5", "0 0 -{}", False),
]


@pytest.mark.parametrize(("edit", "old", "new", "is_affine"), EDITS)
def test_what_only_the_spec_says_is_written_or_compiled(edit, old, new, is_affine):
    robot = pendulum(parameters={"value": (0.3, 0.7, edit)})
    theta = torch.tensor([[0.35], [0.62]], dtype=torch.float64)
    action = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action)
    for row in range(2):
        text = PENDULUM.replace(old, new.format(theta[row].item()))
        other = pendulum(text, parameters={"hinge.damping": (0.0, 0.1)})
        own = torch.full((1, 1), 0.03, dtype=torch.float64)
        same = other.simulator.mean(own, action[row : row + 1])
        assert x[row].numpy() == pytest.approx(same[0].numpy(), abs=1e-7)
    (model,) = robot.simulator.fn.machines[0]._models.values()
    assert (model.writer.compiled is None) == is_affine
    other = pickle.loads(pickle.dumps(robot.simulator))
    assert (other.mean(theta, action) == x).all()


def test_signals_drive_actuators():
    space = SignalActions(
        step("push", length=5.0),
        [-4.0, 0.1],
        [4.0, 0.5],
        input_times=np.arange(0, 1.5, 0.02),
    )
    robot = from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, inputs=space, noise=0.01)
    theta, action = torch.tensor([[1.0]]), torch.tensor([[3.0, 0.2]])
    x = robot.simulator.mean(theta, action)
    assert x.shape == (1, 75, 2)
    assert robot.simulator.channel_names == ["position [m]", "speed [m/s]"]
    assert (x[0, :11, 0] == 0).all()
    rest = 3.0 / 20  # where the spring holds the force
    assert x[0, -20:, 0].mean() == pytest.approx(rest, rel=0.35)
    trials = Trials(
        None,
        x,
        sample_times=robot.simulator.sample_times,
        inputs=space.inputs(action),
        input_times=space.input_times,
    )
    played = {"inputs": trials.inputs, "input_times": trials.input_times}
    again = robot.simulator.mean(theta, trials.action, **played)
    assert (again == x).all()


def test_servos_hold_a_control_that_is_an_action():
    hold = BoxActions([-0.5, -0.5], [0.5, 0.5], names=["shoulder servo", "elbow"])
    robot = from_mjcf(
        ARM,
        {"shoulder servo.kp": (20, 100)},
        sensors=["shoulder", "elbow velocity"],
        actions=hold,
        times=[0.0, 3.0],
        noise={"shoulder": 0.01, "elbow velocity": 0.1},
    )
    action = torch.tensor([[0.3, 0.2]]).repeat(2, 1)
    x = robot.simulator.mean(torch.tensor([[20.0], [100.0]]), action)
    sag = 0.3 - x[:, 1, 0]
    assert sag[0] / sag[1] == pytest.approx(5, rel=0.2)
    assert robot.prior.units == ("N m/rad",)


def test_a_state_that_diverges_is_invalid_and_counted():
    robot = pendulum(parameters={"k": (-1e9, 1.0, "hinge.stiffness")}, times=[0.5, 1.0])
    theta = torch.tensor([[0.5], [-1e9], [0.1]])
    rows = simulate(robot.simulator, theta, torch.full((3, 1), 0.5), seed=0)
    assert rows.status.tolist() == [Outcome.OK, Outcome.INVALID, Outcome.OK]
    x = robot.simulator.mean(theta[[0]], torch.full((1, 1), 0.5))
    few = robot.simulator.mean(theta[:2], torch.full((2, 1), 0.5))
    assert (few[0] == x[0]).all()


#: What does not fit, and what is said of it.
UNFIT = [
    ({"parameters": {"hinge.dampin": (0, 1)}}, "did you mean 'hinge.damping'"),
    ({"parameters": {"bob.mass": (-1, 1)}}, "'bob.mass' from 0 on; got -1 to 1"),
    ({"parameters": {"hinge.damping": 0.1}}, r"\(low, high\) of .*; got 0.1"),
    ({"times": [1.7e9, 1.7e9 + 1]}, "subtract the time at which the trial starts"),
]


@pytest.mark.parametrize(("change", "message"), UNFIT)
def test_what_does_not_fit_is_said(change, message):
    with pytest.raises(ValueError, match=message):
        pendulum(**change)


def test_the_belief_of_a_campaign_is_kept(tmp_path):
    robot = pendulum()
    few = CampaignOptions(network="on demand", refinement=REFINEMENT)
    parts = robot.simulator, robot.prior, robot.actions
    truth, action = torch.tensor([[0.03, 1.0]]), robot.actions.sample((1,), seed=0)
    with Campaign(*parts, directory=tmp_path / "c", seed=0, options=few) as campaign:
        campaign.attach(action[0], parts[0](truth, action)[0])
        belief = campaign.update()
    with Campaign.load(tmp_path / "c") as read:  # as status, watch and report do
        assert not read.state.is_stale
        assert torch.equal(read.belief.mean, belief.mean)
    with Campaign.load(tmp_path / "c", simulator=pendulum().simulator) as loaded:
        assert torch.equal(loaded.belief.log_prob(truth), belief.log_prob(truth))


# A model's source: the same model in every process


CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
BLOCK = """<mujoco><compiler meshdir="parts"/>
<asset><mesh name="block" file="block.obj"/>
<texture name="wood" type="2d" file="missing.png"/>
<material name="wooden" texture="wood" rgba="1 0 0 1"/></asset>
<worldbody><body><joint name="hinge" axis="0 1 0"/>
<geom type="mesh" mesh="block" material="wooden"/></body></worldbody></mujoco>"""


@pytest.fixture
def path(tmp_path):
    (tmp_path / "parts").mkdir()
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += ["f 1 2 4", "f 1 4 3", "f 5 8 6", "f 5 7 8", "f 1 5 6", "f 1 6 2"]
    lines += ["f 3 4 8", "f 3 8 7", "f 1 3 7", "f 1 7 5", "f 2 6 8", "f 2 8 4"]
    (tmp_path / "parts/block.obj").write_text("\n".join(lines))
    (tmp_path / "block.xml").write_text(BLOCK)
    return tmp_path / "block.xml"


def from_elsewhere(path, monkeypatch):
    monkeypatch.chdir(path.parent)
    return mujoco.MjSpec.from_file("block.xml")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match=r"an MJCF file; got none at .*arm.xml; check"):
        Source(tmp_path / "arm.xml")


@pytest.mark.parametrize("is_spec", [False, True])
def test_other_processes_find_meshes_beside_the_file(path, monkeypatch, is_spec):
    source = Source(from_elsewhere(path, monkeypatch) if is_spec else path)
    monkeypatch.chdir("/")
    here, there = source.compile(), pickle.loads(pickle.dumps(source)).compile()
    assert here.body_mass[1] == pytest.approx(2000.0, rel=1e-6)
    np.testing.assert_array_equal(here.body_inertia, there.body_inertia)
