import math

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.__main__ import main as run
from sbi_active.criticism import Criticism
from sbi_active.criticism.data import Measurements
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals import declared_noise
from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.servo_pendulum import (  # pyright: ignore
    Recordings,
    ServoPendulumTask,
    read_recordings,
)
from sbi_active.tasks.servo_pendulum.noise import servo_noise  # pyright: ignore
from sbi_active.tasks.servo_pendulum.task import DATA  # pyright: ignore

FOLDER = DATA.resolve()  # before a test changes the working directory
THETA = torch.tensor([[0.45, 5.0, 0.0045, 0.0015, -0.02]], dtype=torch.float64)
TIME = np.arange(0.004, 6.01, 0.005)


def samples(trajectory, start=0.0):
    """Time, goal, torque enabled and angle of one trial, in which nothing moves."""
    if trajectory == "fall":
        goal, on = np.zeros_like(TIME), np.zeros_like(TIME)
    elif trajectory == "lift_and_drop":
        s = np.minimum(TIME / 2, 1.0)
        goal, on = -math.pi / 2 * (3 * s**2 - 2 * s**3), (TIME < 2.0).astype(float)
    else:
        goal, on = np.sin(TIME**2), np.ones_like(TIME)
    return TIME, goal, on, np.full_like(TIME, start)


def recordings(*trials, rate=5.0):
    """Trials given as (kp, trajectory, start)."""
    kp, names, start = zip(*trials, strict=True)
    parts = [samples(n, s) for n, s in zip(names, start, strict=True)]
    return Recordings.from_samples(kp, names, parts, rate=rate)


@pytest.fixture(scope="module")
def task():
    trials = [
        (kp, name, 0.0)
        for kp in (100.0, 400.0)
        for name in ("sin_time_square", "lift_and_drop")
    ]
    return ServoPendulumTask(data=recordings(*trials))


def every_trial(task, theta=THETA, **friction):
    action = torch.from_numpy(task.recordings.action)
    return task.angles(theta.expand(len(action), -1), action, **friction).numpy()


@pytest.mark.parametrize(
    ("friction", "tolerance"),
    [({}, 0.004), ({"viscous": 0.01}, 0.004), ({"coulomb": 0.05}, 0.01)],
)
def test_the_equations_agree_with_mujoco_at_an_eighth_of_the_step(
    task, friction, tolerance
):
    pytest.importorskip("mujoco")
    from sbi_active.tasks.servo_pendulum.scene import (  # pyright: ignore
        mujoco_angles,
    )

    own = every_trial(task, **friction)
    assert np.ptp(own[1:3], axis=1).min() > 0.2  # they swing
    for trial in (1, 2):
        x = mujoco_angles(THETA[0].numpy(), task.recordings, trial, **friction)
        assert np.abs(own[trial] - x).max() < tolerance


def test_viscous_friction_is_back_emf_until_the_motor_is_off(task):
    kt, resistance = THETA[0, 0], THETA[0, 1]
    b = 0.01
    more = kt + b * resistance / kt  # the same torque a volt, more back-EMF
    other = THETA.clone()
    other[0, 0], other[0, 1] = more, resistance * more / kt
    viscous, electric = every_trial(task, viscous=b), every_trial(task, other)
    off = task.recordings.motor_off
    assert off.tolist() == [False, True, False, True]
    assert np.abs(viscous - electric)[~off].max() < 1e-9
    assert np.abs(viscous - electric)[off].max() > 0.1


def test_a_free_pendulum_keeps_its_energy_without_friction_alone():
    fall = ServoPendulumTask(data=recordings((100.0, "fall", 1.0), rate=50.0))
    strengths: list[dict[str, float]] = [{}, {"load": 0.2}, {"torque": 1.0}]
    free, damped, motor = (every_trial(fall, **f)[0] for f in strengths)
    late = fall.recordings.times > 4
    assert np.abs(free[late] + 0.02).max() == pytest.approx(1.02, abs=2e-3)
    assert np.abs(damped[late]).max() < 0.3
    assert np.array_equal(motor, free)  # no torque while the motor is off


def test_dry_friction_holds_what_it_can_hold():
    weight = 0.49 * 9.81 * 0.1
    fall = ServoPendulumTask(data=recordings((100.0, "fall", 0.5)))
    held = every_trial(fall, coulomb=1.01 * weight * math.sin(0.52))
    assert np.array_equal(held, np.full_like(held, 0.5))
    slides = every_trial(fall, coulomb=0.5 * weight * math.sin(0.52))[0]
    assert slides[-1] == slides[-5]  # at rest before the end
    assert abs(slides[-1]) < 0.3


def test_effects_vanish_at_zero(task):
    bare = every_trial(task)
    assert [e.name for e in task.effects()] == [
        "Coulomb",
        "load-dependent",
        "torque-dependent",
        "viscous",
    ]
    for keyword in ("coulomb", "load", "torque", "viscous"):
        assert np.array_equal(every_trial(task, **{keyword: 0.0}), bare)
        assert np.abs(every_trial(task, **{keyword: 0.05}) - bare).max() > 0.01


def test_a_row_does_not_depend_on_the_others(task):
    theta = task.prior.sample((40,)).double()
    action = task.actions.sample((40,), seed=0)
    load = torch.rand(40)
    x = task.angles(theta, action, load=load)
    few = task.angles(theta[7:9], action[7:9], load=load[7:9])
    assert torch.equal(x[7:9], few)


def test_an_action_that_was_not_recorded(task):
    with pytest.raises(ValueError, match=r"expected the action of a recorded.*300"):
        task.angles(THETA, torch.tensor([[300.0, 0.0]]))


def test_the_real_system_replays(task):
    assert torch.equal(task.real_system(task.actions.values[1]), torch.zeros(30))
    other = task.with_truth([0.45, 5.0, 0.0045, 0.0015, -0.02])
    x = other.real_system(task.actions.values[1], seed=0)
    assert x.shape == (30,)
    assert float(x.abs().max()) > 0.1
    trials = task.trials([0, 2], [1])
    assert trials.role == ["fit", "fit", "held out"]
    assert trials.index.tolist() == [0, 2, 1]


def test_noise_of_unknown_size_covers_its_ranges():
    noise = servo_noise()
    assert noise.posterior is not None
    draws = noise.posterior.sample((4_000,))
    low, middle, high = draws.log().quantile(
        torch.tensor([0.0, 0.5, 1.0]).double(), dim=0
    )
    assert low.exp().tolist() == pytest.approx([0.005, 0.02], rel=0.02)
    assert high.exp().tolist() == pytest.approx([0.5, 6.0], rel=0.02)
    # A uniform's median has the standard error width / 2 / sqrt(n).
    error = (high - low) / 2 / 4_000**0.5
    assert bool(((middle - (low + high) / 2).abs() < 4 * error).all())
    independent = servo_noise(correlated=False).sample(torch.zeros(500, 30))
    product = independent[:, 1:] * independent[:, :-1] / independent.square().mean()
    assert abs(float(product.mean())) < 4 * float(product.std()) / 500**0.5


def test_the_loop_sums_the_servo_noise_out(task):
    """Its likelihood is the sum over the declared prior's cells."""
    trials = task.trials([1])
    measured = Measurements.of(trials)
    residual = 0.05 * torch.sin(3 * torch.from_numpy(task.recordings.times))[None]
    own = declared_noise(servo_noise(), measured).log_likelihood(residual.numpy())
    posterior = servo_noise().posterior
    times = (posterior.shared.edges[1:] * posterior.shared.edges[:-1]).sqrt()
    sds = posterior.sd.nodes[0]
    parts = [
        AutocorrelatedNoise(sd, tau).log_prob(
            residual, torch.zeros_like(residual), times=trials.sample_times
        )
        for sd in sds.tolist()
        for tau in times.tolist()
    ]
    expected = torch.stack(parts).logsumexp(0) - math.log(len(parts))
    assert float(own[0]) == pytest.approx(float(expected), abs=1e-6)
    # As noise of a simulator it has 256 draws of the prior for its parameters; the grid
    # has the middle of each cell, which is worth up to 5 %.
    draws = posterior.sample((4_000,))
    each = AutocorrelatedNoise(0.05, 1.0).log_prob(
        residual.expand(4_000, -1),
        torch.zeros(4_000, 30).double(),
        times=trials.sample_times,
        parameters=draws,
    )
    share = (each - expected).exp()
    marginal = servo_noise().log_prob(
        residual, torch.zeros_like(residual), times=trials.sample_times
    )
    error = float(share.std()) / 256**0.5
    assert abs(float((marginal - expected).exp()) - 1) < 4 * error + 0.05


def test_a_truth_of_the_wrong_size(task):
    with pytest.raises(ValueError, match="expected theta_true of 5 numbers"):
        task.with_truth([1.0, 2.0])


# Reading what was recorded


@pytest.fixture
def folder(tmp_path):
    tables = []
    for i, name in enumerate(("sin_time_square", "lift_and_drop")):
        time, goal, on, angle = samples(name, 0.1 * i)
        tables.append(
            pd.DataFrame(
                {
                    "trial": i,
                    "time_s": time,
                    "goal_rad": goal,
                    "torque_enable": on,
                    "position_rad": angle,
                }
            )
        )
    pd.concat(tables).to_csv(tmp_path / "samples.csv", index=False)
    pd.DataFrame(
        {"trial": [0, 1], "trajectory": ["sin_time_square", "lift_and_drop"], "kp": 100}
    ).to_csv(tmp_path / "trials.csv", index=False)
    return tmp_path


def test_reading_interpolates_and_finds_when_the_motor_is_off(folder):
    found = read_recordings(folder)
    assert found.angle.shape == (2, 30)
    assert found.times[[0, -1]].tolist() == pytest.approx([0.2, 6.0])
    assert found.angle[1] == pytest.approx(np.full(30, 0.1))
    middle = (np.arange(1500) + 0.5) * 0.004
    # Linear interpolation over 5 ms of a second derivative up to 4 t^2 + 2.
    assert np.abs(found.goal[0] - np.sin(middle**2))[2:].max() < 146 * 0.005**2 / 8
    # Off from the first sample at or after 2 s, which is at 2.004 s.
    assert found.enabled[1].sum() * 0.004 == pytest.approx(2.004, abs=1e-9)
    assert get_task("servo_pendulum", data=folder).actions.values.tolist() == [
        [100.0, 0.0],
        [100.0, 1.0],
    ]


def edited(folder, name, change):
    table = pd.read_csv(folder / name)
    change(table).to_csv(folder / name, index=False)
    return folder


def test_a_folder_without_recordings(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"recorded trials in .*trials\.csv"):
        read_recordings(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("samples.csv", lambda t: t.drop(columns="goal_rad"), "got no goal_rad among"),
        ("trials.csv", lambda t: pd.concat([t, t]), "got trial 0 more than once"),
        ("samples.csv", lambda t: t[t["trial"] == 0], "got none of trial 1"),
        ("samples.csv", lambda t: t[t["time_s"] < 5], "got 4.999 s in trial 0"),
        ("samples.csv", lambda t: t[::-1], "time_s that increases; got"),
        (
            "samples.csv",
            lambda t: t.assign(position_rad=t["position_rad"].where(t.index != 3)),
            "finite position_rad; got nan in sample 3 of trial 0",
        ),
    ],
)
def test_recordings_that_do_not_fit(folder, name, change, message):
    with pytest.raises(ValueError, match=message):
        read_recordings(edited(folder, name, change))


def test_the_benchmark_says_where_it_looked(tmp_path, capsys):
    assert (
        run(
            [
                "measured.servo_pendulum",
                "--data",
                str(tmp_path),
                "--out",
                str(tmp_path / "out.json"),
            ]
        )
        == 2
    )
    assert "got no such file; give the folder" in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()


# The closed loop


def judged(friction, *, seed):
    """The verdict on simulated trials with errors of .03 rad, correlated over .3 s."""
    trials = [
        (kp, name, 0.0)
        for kp in (100.0, 800.0)
        for name in ("sin_time_square", "lift_and_drop")
    ]
    quiet = ServoPendulumTask(data=recordings(*trials))
    r = quiet.recordings
    mean = torch.from_numpy(every_trial(quiet, **friction))
    noise = AutocorrelatedNoise(0.03, 0.3)
    seeds = torch.arange(len(r)) + 100 * seed
    x = noise.sample(mean, seeds, times=torch.from_numpy(r.times))
    found = Recordings(
        r.kp, r.trajectory, r.goal, r.enabled, r.start, r.times, x.numpy()
    )
    real = ServoPendulumTask(data=found)
    return Criticism(
        real.simulator,
        real.prior,
        real.trials(range(len(r))),
        effects=real.effects(),
        actions=real.actions,
    ).trace()


@pytest.mark.slow
def test_a_servo_without_friction_lacks_nothing():
    assert judged({}, seed=0).verdict == "none"


@pytest.mark.slow
def test_coulomb_friction_is_found():
    tracing = judged({"coulomb": 0.06}, seed=0)
    assert tracing.verdict == "Coulomb"
    mean, sd = tracing.estimates[0].mean[0], tracing.estimates[0].sd[0]
    assert abs(mean - 0.06) < 4 * sd


@pytest.mark.slow
@pytest.mark.skipif(not FOLDER.is_dir(), reason="needs the recorded trials")
def test_dry_friction_is_what_the_recorded_servo_has():
    task = ServoPendulumTask(data=FOLDER)
    off = np.flatnonzero(task.recordings.motor_off).tolist()
    assert len(task.recordings) == 16
    assert len(off) == 4
    trials = task.trials([0, 3, 12, off[1]])
    loop = Criticism(task.simulator, task.prior, trials, effects=task.effects())
    assert loop.detect().alarm
    found = loop.rivals

    def log_z(name):
        return found.fit(ModelKey((name,))).evidence.log_evidence

    dry = max(log_z(n) for n in ("Coulomb", "load-dependent"))
    assert dry > log_z("torque-dependent") + 20
    assert dry > log_z("viscous") + 20
