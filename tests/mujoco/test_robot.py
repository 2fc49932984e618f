"""Robots from their MJCF: what they simulate, and what is refused."""

import pickle

import mujoco
import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.robots.models import ARM, CART_POLE, PENDULUM, SPRING_MASS, TIMES
from sbi_active import BoxActions
from sbi_active.actions.signals import SignalActions
from sbi_active.actions.waveforms import step
from sbi_active.criticism import Trials
from sbi_active.mujoco import Robot, from_mjcf
from sbi_active.simulation import Outcome, simulate

RELEASE = BoxActions([-1.5], [1.5], names=["hinge"])


def pendulum(**options) -> Robot:
    given = {
        "parameters": {"hinge.damping": (0.0, 0.1), "bob.mass": (0.5, 2.0)},
        "sensors": ["hinge"],
        "actions": RELEASE,
        "times": TIMES,
        "noise": 0.01,
    }
    return from_mjcf(PENDULUM, **{**given, **options})


def test_a_pendulum_moves_as_one_stepped_by_hand():
    robot = pendulum()
    theta = torch.tensor([[0.02, 1.5], [0.09, 0.6]], dtype=torch.float64)
    action = torch.tensor([[0.4], [-1.2]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action)
    for row in range(2):
        damping, mass = theta[row].tolist()
        text = PENDULUM.replace('damping="0.03"', f'damping="{damping!r}"')
        model = mujoco.MjModel.from_xml_string(
            text.replace('mass="1"', f'mass="{mass!r}"')
        )
        data = mujoco.MjData(model)
        data.qpos[0] = action[row, 0]
        angles = []
        for _ in range(151):
            angles.append(data.qpos[0])
            mujoco.mj_step(model, data)
        assert x[row].numpy() == pytest.approx(np.array(angles)[10::10], abs=1e-12)


def test_parts_are_named_and_have_units():
    robot = pendulum()
    assert robot.simulator.parameter_names == ["hinge.damping", "bob.mass"]
    assert robot.prior.units == ("N m s/rad", "kg")
    assert robot.prior.names == ("hinge.damping", "bob.mass")
    assert robot.simulator.channel_names == ["hinge [rad]"]
    assert robot.actions is RELEASE
    assert robot.trials is None


def test_rows_do_not_depend_on_batches_workers_or_threads():
    robot = pendulum()
    theta, action = robot.prior.sample((70,)), RELEASE.sample((70,))
    x = simulate(robot.simulator, theta, action, seed=0).x
    for options in ({"batch_size": 7}, {"num_workers": 2, "batch_size": 11}):
        assert (
            simulate(robot.simulator, theta, action, seed=0, **options).x == x
        ).all()
    threads = pendulum(threads=2).simulator
    again = threads.mean(theta, action)
    assert (again == robot.simulator.mean(theta, action)).all()
    one = torch.cat([robot.simulator.mean(t[None], a[None])
                     for t, a in zip(theta[:9], action[:9], strict=True)])  # fmt: skip
    assert (one == again[:9]).all()


def test_a_simulator_can_be_pickled():
    robot = pendulum()
    theta, action = robot.prior.sample((3,)), RELEASE.sample((3,))
    other = pickle.loads(pickle.dumps(robot.simulator))
    assert (other.mean(theta, action) == robot.simulator.mean(theta, action)).all()


@pytest.mark.parametrize("given", ["text", "path", "spec"])
def test_a_model_comes_as_text_path_or_spec(given, tmp_path):
    file = tmp_path / "pendulum.xml"
    file.write_text(PENDULUM)
    spec = mujoco.MjSpec.from_string(PENDULUM)
    source = {"text": PENDULUM, "path": file, "spec": spec}[given]
    robot = from_mjcf(source, {"hinge.damping": (0.0, 0.1)}, times=TIMES)
    assert robot.simulator.noise is not None  # the sensor's, in the MJCF
    assert robot.simulator.noise.sd == pytest.approx(0.01)
    x = robot.simulator.mean(torch.full((1, 1), 0.05), torch.zeros(1, 1))
    assert x.shape == (1, 15)
    assert (x == 0).all()


def length(spec, value):
    spec.body("bob").first_geom().fromto = [0, 0, 0, 0, 0, -value]


def armature(spec, value):
    spec.joint("hinge").armature = value


@pytest.mark.parametrize(
    ("edit", "old", "new", "is_affine"),
    [
        (armature, 'damping="0.03"', 'damping="0.03" armature="{}"', True),
        (length, "0 0 -.5", "0 0 -{}", False),
    ],
)
def test_what_only_the_spec_says_is_written_or_compiled(edit, old, new, is_affine):
    robot = pendulum(parameters={"value": (0.3, 0.7, edit)})
    theta = torch.tensor([[0.35], [0.62]], dtype=torch.float64)
    action = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action)
    for row in range(2):
        text = PENDULUM.replace(old, new.format(theta[row].item()))
        other = from_mjcf(
            text,
            {"hinge.damping": (0.0, 0.1)},
            sensors=["hinge"],
            actions=RELEASE,
            times=TIMES,
            noise=0.01,
        )
        own = torch.full((1, 1), 0.03, dtype=torch.float64)
        same = other.simulator.mean(own, action[row : row + 1])
        assert x[row].numpy() == pytest.approx(same[0].numpy(), abs=1e-7)
    (model,) = robot.simulator.fn.machines[0]._models.values()
    assert bool(model.writer.fields) == is_affine
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
    again = robot.simulator.mean(
        theta, trials.action, inputs=trials.inputs, input_times=trials.input_times
    )
    assert (again == x).all()


def logs(num=2):
    t = np.arange(0, 1, 0.01)
    return [
        pd.DataFrame(
            {"time": t, "push": np.sin(5 * t + k), "position": 0 * t, "speed": 0 * t}
        )
        for k in range(num)
    ]


def test_logs_become_trials():
    frames = logs()
    frames[1].loc[3:5, "position"] = np.nan
    frames[1]["start slide"] = frames[0]["start slide"] = 0.1
    robot = from_mjcf(
        SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames, noise=0.01
    )
    assert robot.trials is not None
    assert robot.trials.x.shape == (2, 100, 2)
    assert robot.trials.x.isnan().sum() == 3
    assert robot.trials.start["slide"].tolist() == [0.1, 0.1]
    x = robot.simulator.mean(
        torch.ones(2, 1),
        robot.trials.action,
        inputs=robot.trials.inputs,
        input_times=robot.trials.input_times,
        start=robot.trials.start,
    )
    assert x[:, 0, 0].tolist() == pytest.approx([0.1, 0.1])


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": {"hinge.dampin": (0, 1)}}, "did you mean 'hinge.damping'"),
        ({"parameters": {"hing.damping": (0, 1)}}, "did you mean 'hinge.damping'"),
        ({"parameters": {"hinge.damping": (1, 0)}}, "low < high"),
        ({"parameters": {"hinge.damping": 3}}, "as .low, high"),
        ({"parameters": {}}, "at least one parameter"),
        ({"parameters": {"bob.mass": (0, 1)}}, "inertia; got none of 'hinge'"),
        ({"parameters": {"bob.mass": (-1, 1)}}, "'bob.mass' from 0 on; got -1 to 1"),
        ({"times": [0.1, np.nan]}, "times that increase from 0 s on"),
        ({"times": [-0.1, 0.1]}, "times that increase from 0 s on"),
        ({"times": [0.2, 0.1]}, "times that increase from 0 s on"),
        ({"times": [1.7e9, 1.7e9 + 1]}, "subtract the time at which the trial starts"),
        ({"threads": 0}, "at least one thread; got threads=0"),
        ({"threads": 1.5}, "at least one thread; got threads=1.5"),
        ({"sensors": ["hinges"]}, "did you mean 'hinge'"),
        ({"actions": BoxActions([0], [1], names=["hingo"])}, "did you mean 'hinge'"),
        ({"start": {"hinge_": 1.0}}, "did you mean 'hinge'"),
        ({"noise": {"hing": 1.0}}, "did you mean 'hinge'"),
    ],
)
def test_what_does_not_fit_is_said(change, message):
    with pytest.raises(ValueError, match=message):
        pendulum(**change)


def test_a_model_that_does_not_compile_is_said():
    with pytest.raises(ValueError, match="expected an MJCF that compiles"):
        from_mjcf(PENDULUM.replace("capsule", "no shape"), {"hinge.damping": (0, 1)})
    with pytest.raises(FileNotFoundError, match="no such file"):
        from_mjcf("no/such.xml", {"hinge.damping": (0, 1)})


#: A servo, called as its joint is, holds an arm that a mocap body pulls at.
HELD = """<mujoco>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="arm"><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/></body>
  </worldbody>
  <actuator><position name="{name}" joint="hinge" kp="50"/></actuator>
  <equality><connect body1="arm" body2="hand" anchor=".5 0 0"/></equality>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
  <keyframe><key name="home" qpos=".7" qvel="-1" ctrl=".6" mpos=".3 0 .2"/></keyframe>
</mujoco>"""


def held(name: str, **options) -> list[float]:
    robot = from_mjcf(
        HELD.format(name=name),
        {"hinge.damping": (0.0, 1.0)},
        **{"times": [0.0, 0.5], "noise": 0.01, **options},
    )
    value = torch.tensor([[0.2]], dtype=torch.float64)
    return robot.simulator.mean(torch.tensor([[0.1]]).double(), value)[0].tolist()


def by_hand(*, key: bool, **start: float) -> list[float]:
    model = mujoco.MjModel.from_xml_string(HELD.format(name="servo"))
    model.dof_damping[0] = 0.1
    data = mujoco.MjData(model)
    if key:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    for field, value in start.items():
        getattr(data, field)[0] = value
    for _ in range(251):
        mujoco.mj_step(model, data)
        if data.time == model.opt.timestep:
            first = float(data.sensordata[0])
    return [first, float(data.sensordata[0])]


def test_a_keyframe_gives_controls_and_mocap_poses_too():
    x = held("servo", start="home")
    assert x == pytest.approx(by_hand(key=True), abs=1e-12)
    assert held("servo") == pytest.approx(by_hand(key=False), abs=1e-12)
    start = {"hinge": 0.7, "hinge velocity": -1.0, "servo control": 0.6}
    start |= {"hand mocap[0]": 0.3, "hand mocap[2]": 0.2}
    assert held("servo", start=start) == pytest.approx(x, abs=1e-12)


def test_a_keyframe_holds_beside_forces_that_are_stepped():
    robot = from_mjcf(
        HELD.format(name="servo"),
        {"hinge.damping": (0.0, 1.0)},
        **{"times": [0.0, 0.5], "noise": 0.01, "start": "home"},
    )

    def push(q, v, t, phi):
        return phi

    x = robot.simulator.mean(
        torch.tensor([[0.1]]).double(),
        torch.zeros(1, 1).double(),
        force={push: torch.zeros(1, 1).double()},
    )
    assert x[0].tolist() == pytest.approx(by_hand(key=True), abs=1e-9)


@pytest.mark.parametrize("name", ["servo", "hinge"])
def test_an_action_sets_one_thing_where_joint_and_actuator_share_a_name(name):
    control = by_hand(key=True, ctrl=0.2)
    for called in (name, f"{name} control"):
        actions = BoxActions([0.1], [0.3], names=[called])
        x = held(name, start="home", actions=actions)
        assert x == pytest.approx(control, abs=1e-12)
    actions = BoxActions([0.1], [0.3], names=["hinge position"])
    x = held(name, start="home", actions=actions)
    assert x == pytest.approx(by_hand(key=True, qpos=0.2), abs=1e-12)


def test_a_name_that_a_signal_drives_is_no_start_of_its_joint():
    grid = np.arange(0, 1, 0.02)
    signal = step("hinge", length=1.0)
    played = SignalActions(signal, [-1.0, 0.1], [1.0, 0.5], input_times=grid)
    for name, message in (("hinge", "'hinge position'"), ("hinge position", None)):
        actions = BoxActions([0.1], [0.3], names=[name])
        given = {"inputs": played, "actions": actions, "noise": 0.01}
        arm = HELD.format(name="hinge"), {"hinge.damping": (0.0, 1.0)}
        if message:
            with pytest.raises(ValueError, match=message):
                from_mjcf(*arm, **given)
        else:
            assert from_mjcf(*arm, **given).actions.names[-1] == name


def test_a_log_has_a_column_each_for_a_sensor_and_an_input_of_one_name():
    time = np.arange(0, 0.2, 0.01)
    log = {"time": time, "hinge": 0 * time, "hinge control": 0.3 + 0 * time}
    arm = HELD.format(name="hinge"), {"hinge.damping": (0.0, 1.0)}
    given = {"sensors": ["hinge"], "noise": 0.01}
    robot = from_mjcf(*arm, **given, recordings=[log])
    assert robot.trials.inputs["hinge"].unique().item() == pytest.approx(0.3)
    del log["hinge control"]
    with pytest.raises(ValueError, match="column 'hinge control' in recording 0"):
        from_mjcf(*arm, **given, recordings=[log])


def out_of_range(frame):
    frame["push"] *= 6


def nan_input(frame):
    frame.loc[7, "push"] = np.nan


def renamed(frame):
    frame.rename(columns={"push": "pusher"}, inplace=True)


def backwards(frame):
    frame.loc[7, "time"] = 0.01


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (out_of_range, "within its ctrlrange, -5 to 5"),
        (nan_input, "finite 'push' in recording 1; got NaN or inf in row 7"),
        (renamed, "column 'push' in recording 1; .* rename 'pusher'"),
        (backwards, "time that increases in recording 1"),
    ],
)
def test_logs_that_do_not_fit_are_said(spoil, message):
    frames = logs()
    spoil(frames[1])
    with pytest.raises(ValueError, match=message):
        from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames)


def test_signals_out_of_range_and_unknown_actuators_are_said():
    grid = np.arange(0, 1, 0.02)
    loud = SignalActions(
        step("push", length=1.0), [-9.0, 0.1], [9.0, 0.5], input_times=grid
    )
    with pytest.raises(ValueError, match="within its ctrlrange"):
        from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, inputs=loud)
    other = SignalActions(
        step("pull", length=1.0), [-1.0, 0.1], [1.0, 0.5], input_times=grid
    )
    with pytest.raises(ValueError, match="name of an actuator|did you mean 'push'"):
        from_mjcf(CART_POLE, {"cart.mass": (0.5, 2)}, inputs=other)


def test_a_parameter_that_changes_nothing_is_said_at_once():
    with pytest.warns(UserWarning, match="bob.com_y change nothing that is read"):
        pendulum(parameters={"hinge.damping": (0, 0.1), "bob.com_y": (-0.1, 0.1)})


def test_models_with_and_without_a_payload_share_their_parameters():
    loaded = SPRING_MASS.replace(
        "</body>",
        '<geom type="sphere" size=".05" mass="1" contype="0" conaffinity="0"/></body>',
    )
    robot = from_mjcf(
        [SPRING_MASS, loaded],
        {"slide.damping": (0.1, 1.0)},
        sensors=["position"],
        actions=BoxActions([1.0, 0.0], [2.0, 1.0], names=["push", "model"]),
        times=TIMES,
        noise=0.01,
    )
    theta = torch.full((2, 1), 0.3, dtype=torch.float64)
    x = robot.simulator.mean(theta, torch.tensor([[2.0, 0.0], [2.0, 1.0]]).double())
    assert x[0].max() == pytest.approx(0.2, rel=0.15)  # the same at rest, and later
    assert x[1].argmax() > x[0].argmax()
    with pytest.raises(ValueError, match="same joints"):
        from_mjcf([SPRING_MASS, CART_POLE], {"cart.mass": (0.5, 2)}, sensors=["slide"])


def test_a_center_of_mass_moves_where_the_model_has_room_for_it():
    ball = """<mujoco><option timestep="0.01"/><worldbody><body name="ball">
      <joint name="hinge" axis="0 1 0" pos="0 0 .3"/><geom size=".1" mass="1"/>
      </body></worldbody></mujoco>"""
    given = {"sensors": ["hinge"], "times": TIMES, "start": {"hinge": 0.0}}
    robot = from_mjcf(ball, {"ball.com_x": (-0.1, 0.1)}, noise=0.01, **given)
    theta = torch.tensor([[0.05], [0.0]], dtype=torch.float64)
    x = robot.simulator.mean(theta, torch.zeros(2, 1).double())
    assert (x[1] == 0).all()
    assert x[0].abs().max() > 0.2  # it swings around where it hangs, .165 rad away
    sliding = ball.replace('axis="0 1 0" pos="0 0 .3"', 'type="slide" axis="1 0 0"')
    with pytest.raises(ValueError, match="compiles as simple"):
        from_mjcf(sliding, {"ball.com_x": (-0.1, 0.1)}, noise=0.01, **given)


def encoder_log(**changes):
    time = np.arange(0.0, 1.0, 0.02)
    log = {"time": time, "angle": 0.3 * np.sin(3 * time), "servo": 0 * time}
    return {**log, **changes}


def read_logs(*logs, xml=HELD):
    return from_mjcf(
        xml.format(name="servo"),
        {"hinge.damping": (0.0, 1.0)},
        noise=0.01,
        recordings=[*logs],
    ).trials


def test_dates_are_seconds_since_the_first():
    for unit in ("ms", "us", "ns"):
        stamps = np.datetime64("2026-01-01") + (20 * np.arange(50)).astype(
            "timedelta64[ms]"
        ).astype(f"timedelta64[{unit}]")
        dates = pd.Series(stamps).dt.tz_localize("UTC")
        for time in (stamps, dates):
            trials = read_logs(encoder_log(time=time))
            assert trials.sample_times.tolist() == pytest.approx(
                (0.02 * np.arange(50)).tolist()
            )


def test_a_log_of_milliseconds_is_said_before_anything_runs():
    with pytest.warns(UserWarning, match="10,000 time steps of 0.002 s.*in ms"):
        read_logs(encoder_log(time=1_000 * encoder_log()["time"]))


def test_angles_that_wrap_or_are_degrees_are_said():
    turning = np.linspace(0, 15, 50)
    with pytest.warns(UserWarning, match=r"jumps by about 2 pi in 2 places"):
        read_logs(encoder_log(angle=np.remainder(turning, 2 * np.pi)))
    limited = HELD.replace('axis="0 1 0"', 'axis="0 1 0" limited="true" range="-90 90"')
    limited = limited.replace('name="angle"', 'name="hinge"')
    log = encoder_log(hinge=np.linspace(0, 60, 50))
    del log["angle"]
    with pytest.warns(UserWarning, match="range ends at 1.57.* rad: are these degrees"):
        read_logs(log, xml=limited)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": encoder_log()["time"] + 1.7e9}, "subtract the time at which"),
        ({"time": encoder_log()["time"] - 1}, "subtract the time at which"),
        ({"angle": encoder_log()["angle"] + 1j}, "real numbers in column angle"),
        ({"angle": ["0.1 rad"] * 50}, "numbers in column 'angle'.*'0.1 rad' in row 0"),
    ],
)
def test_a_log_that_is_no_log_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        read_logs(encoder_log(**changes))


def test_a_file_of_a_log_keeps_its_cells(tmp_path):
    frame = pd.DataFrame(encoder_log())
    path = tmp_path / "log.csv"
    path.write_text("# a comment\n" + frame.to_csv(index=False), encoding="utf-8-sig")
    trials = read_logs(path)
    assert trials.x[0].tolist() == pytest.approx(frame["angle"].tolist())
