"""The data and parameters of mujoco.sysid, and beliefs for it."""

import mujoco
import mujoco.rollout
import numpy as np
import pytest
import torch
import yaml
from mujoco import sysid
from sbi.utils import BoxUniform

from benchmarks.robots.models import SPRING_MASS
from sbi_active.mujoco import belief_to_parameters, from_sysid, randomization

if not hasattr(sysid, "Parameter"):
    pytest.skip(
        "needs mujoco.sysid; run pip install 'sbi-active[sysid]'",
        allow_module_level=True,
    )


def mass(spec, parameter):
    spec.body("cart").first_geom().mass = float(parameter.value[0])


def gear(spec, parameter):
    spec.actuator("push").gear[0] = float(parameter.value[0])


def stiffness(spec, parameter):
    spring = spec.joint("slide")
    spring.stiffness = parameter.value[0] + 0.0 * np.asarray(spring.stiffness)


def parameters(delay=False):
    params = sysid.ParameterDict()
    params.add(sysid.Parameter("mass", 1.0, 0.5, 2.0, modifier=mass))
    params.add(
        sysid.Parameter("stiffness", 20.0, 5.0, 40.0, modifier=stiffness, frozen=True)
    )
    params.add(sysid.Parameter("gear", 1.0, 0.5, 2.0, modifier=gear))
    if delay:
        params.add(sysid.Parameter("delay", 0.01, 0.0, 0.05))
        params.add(sysid.Parameter("scale", 1.0, 0.8, 1.2))
        params.add(sysid.Parameter("shift", 0.0, -0.1, 0.1))
    return params


def payload(text):
    return text.replace(
        "</body>",
        '<geom type="sphere" size=".05" mass=".7" contype="0" conaffinity="0"/></body>',
    )


def sequences(text=SPRING_MASS, name="bare"):
    spec = mujoco.MjSpec.from_string(text)
    model = spec.compile()
    data = mujoco.MjData(model)
    t = np.arange(0, 1.0, 0.01)
    starts, controls, readings = [], [], []
    for k in range(2):
        control = np.sin((4 + k) * t)[:, None]
        data.qpos[:] = 0.05 * k
        start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
        state, sensor = mujoco.rollout.rollout(
            model, mujoco.MjData(model), start, control[:-1]
        )
        starts.append(start)
        controls.append(sysid.TimeSeries(t, control))
        readings.append(
            sysid.TimeSeries.from_names(
                state[0, ::3, 0], sensor[0, ::3].copy(), model, None
            )
        )
    names = [f"{name} {k}" for k in range(2)]
    return sysid.ModelSequences(name, spec, names, starts, controls, readings)


def test_outcomes_are_what_sysid_predicts():
    """Two specs share theta, and outcomes are signals on the measured grid."""
    groups = [sequences(), sequences(payload(SPRING_MASS), "payload")]
    params = parameters()
    robot = from_sysid(groups, params, noise=0.01)
    assert robot.simulator.parameter_names == ["mass", "gear"]
    assert [p.item() for p in robot.prior.base_dist.low] == pytest.approx([0.5, 0.5])
    assert robot.trials.names == ("bare 0", "bare 1", "payload 0", "payload 1")
    residual_fn = sysid.build_residual_fn(models_sequences=groups)
    for theta in ([1.0, 1.0], [1.4, 0.8]):
        # Of a copy: sysid changes the spec that it was given.
        _, predicted, _ = residual_fn(np.array(theta), params.copy())
        rows = torch.tensor([theta] * 4, dtype=torch.float64)
        x = robot.simulator.mean(
            rows,
            robot.trials.action,
            inputs=robot.trials.inputs,
            input_times=robot.trials.input_times,
            start=robot.trials.start,
            times=robot.trials.sample_times.expand(4, -1),
        )
        for k in range(4):
            (series,) = predicted[k]
            times = robot.trials.sample_times.numpy()
            at = np.searchsorted(series.times, times - 1e-9)
            assert series.times[at] == pytest.approx(times)
            assert x[k].numpy() == pytest.approx(series.data[at], abs=1e-6)
    played = robot.simulator.mean(rows, robot.actions.listed().double())
    assert played.numpy() == pytest.approx(x.numpy(), abs=1e-9)


def test_a_transform_acts_on_what_is_predicted():
    params = parameters(delay=True)
    transform = sysid.SignalTransform(normalize=False)
    transform.delay("*", params["delay"])
    transform.gain("position", params["scale"], target="predicted")
    transform.bias("position", params["shift"], target="measured")
    transform.enable_sensors(["position"])
    group = sequences()
    robot = from_sysid(group, params, transform=transform, noise=0.01)
    assert robot.simulator.channel_names == ["position"]
    given = {"models_sequences": [group], "modify_residual": transform.apply}
    residual_fn = sysid.build_residual_fn(**given)
    theta = np.array([1.2, 0.9, 0.017, 1.1, 0.03])
    found, _, measured = residual_fn(theta, params.copy())
    rows = torch.tensor(theta)[None].expand(2, -1)
    x = robot.simulator.mean(rows, robot.actions.listed().double())
    for k in range(2):
        (series,) = measured[k]
        residual = np.asarray(found[k]).reshape(len(series.times), -1)[:, 0]
        own = robot.trials.x[k].numpy() - x[k].numpy()
        assert own == pytest.approx(residual, abs=1e-6)


def test_a_belief_comes_back_as_parameters(tmp_path):
    params = parameters()
    belief = BoxUniform(torch.tensor([0.9, 1.0]), torch.tensor([1.1, 1.4]))
    file = tmp_path / "found.yaml"
    found = belief_to_parameters(belief, params, path=file)
    assert found["mass"].value == pytest.approx([1.0], abs=0.01)
    assert found["gear"].get_bounds()[0] == pytest.approx([1.01], abs=0.01)
    assert found["stiffness"].value == [20.0]
    assert found["mass"].modifier is mass
    assert params["mass"].value == [1.0]
    loaded = sysid.ParameterDict.load_from_disk(file)
    assert loaded.as_vector() == pytest.approx(found.as_vector())
    assert loaded["stiffness"].frozen
    assert {*yaml.safe_load(file.read_text())} == {"mass", "stiffness", "gear"}
    fresh = belief_to_parameters(belief, names=["a", "b"])
    assert fresh.as_vector() == pytest.approx(found.as_vector())
    with pytest.raises(ValueError, match="belief over 5 free"):
        belief_to_parameters(belief, parameters(delay=True))


def test_randomization_keeps_what_parameters_have_in_common():
    covariance = torch.tensor([[1.0, 0.9], [0.9, 1.0]])
    line = torch.distributions.MultivariateNormal(torch.zeros(2), covariance)
    found = randomization(line, [0.5, 0.95], names=["a", "b"], num_samples=4_000)
    low, high = found.ranges[0.95]["a"]
    assert (low, high) == (pytest.approx(-1.96, abs=0.1), pytest.approx(1.96, abs=0.1))
    assert found.ranges[0.5]["b"][1] == pytest.approx(0.674, abs=0.05)
    assert np.corrcoef(found.samples.T)[0, 1] == pytest.approx(0.9, abs=0.03)
    with pytest.raises(ValueError, match="between 0 and 1"):
        randomization(line, [95], names=["a", "b"])
    with pytest.raises(ValueError, match="names"):
        randomization(line)
