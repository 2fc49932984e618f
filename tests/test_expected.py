"""Keywords that are mistyped, and what a notebook shows of an object."""

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    InformationGainDesigner,
    SimulatorModel,
    simulate,
)
from sbi_active.criticism import Effect, Trials, close_loop
from sbi_active.design import GradientSearch
from sbi_active.mujoco import from_mjcf
from sbi_active.simulation import Simulations

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([1.0, 2.0], names=["push"])
NONE = torch.zeros(0, 1), torch.zeros(0, 1)
SLOTS = ["height", "angle"]


def slide(theta, action):
    return theta * action


@pytest.mark.parametrize(
    ("call", "wrong", "meant"),
    [
        (CampaignOptions, "num_simulation", "num_simulations"),
        (lambda **k: CampaignOptions.of(k), "num_sample", "num_samples"),
        (lambda **k: Campaign(slide, PRIOR, ACTIONS, **k), "metod", "method"),
        (
            lambda **k: InformationGainDesigner(ACTIONS, **k),
            "estimators",
            "estimator",
        ),
        (lambda **k: SimulatorModel(slide, **k), "noize", "noise"),
        (lambda **k: simulate(slide, *NONE, **k), "worker", "workers"),
        (lambda **k: Trials([0.0], [0.0], **k), "sample_time", "sample_times"),
        (lambda **k: from_mjcf("", {}, **k), "sensor", "sensors"),
        (close_loop, "warmup", "warm_up"),
        (Effect, "prio", "prior"),
    ],
)
def test_a_mistyped_keyword_is_told_with_the_one_that_was_meant(call, wrong, meant):
    with pytest.raises(TypeError, match=f"got '{wrong}'; did you mean '{meant}'"):
        call(**{wrong: None})


@pytest.mark.parametrize(
    ("thing", "shown"),
    [
        (
            SimulatorModel(
                slide,
                noise=0.5,
                parameter_names=["mass"],
                channel_names=SLOTS,
                sample_times=torch.linspace(0, 1, 51),
            ),
            "SimulatorModel(slide, noise=GaussianNoise(sd=0.5), "
            "parameter_names=[mass], channel_names=[height, angle], "
            "sample_times=51 from 0 to 1)",
        ),
        (
            InformationGainDesigner(ACTIONS, num_samples=100),
            "InformationGainDesigner(DiscreteActions(2 x push), num_samples=100, "
            "search=ExhaustiveSearch())",
        ),
        (
            Effect.keyword("drag", prior=HalfNormal(0.1), units="1/m"),
            "Effect(drag [1/m], of the dynamics)",
        ),
        (
            Simulations(torch.zeros(3, 2), torch.zeros(3, 1), torch.zeros(3, 4)),
            "Simulations(theta (2,), action (1,), x (4,): 3 ok)",
        ),
    ],
)
def test_a_repr_is_a_line_that_says_what_it_is(thing, shown):
    assert repr(thing) == shown


def test_no_repr_of_what_a_notebook_shows_is_an_address():
    robot = """<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body>
        </worldbody><sensor><jointpos joint="hinge"/></sensor></mujoco>"""
    made = from_mjcf(robot, {"hinge.damping": (0.0, 0.1)}, noise=0.01, times=[1.0])
    space = BoxActions([0.0], [1.0])
    for thing in (made, made.simulator, GradientSearch(), space, made.actions):
        assert " at 0x" not in repr(thing)
