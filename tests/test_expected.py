"""Keywords that are mistyped, and what a notebook shows of an object."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    InformationGainDesigner,
    SimulatorModel,
)
from sbi_active.criticism import Trials
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.mujoco import from_mjcf
from sbi_active.simulation.workers.settings import Workers

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([1.0, 2.0], names=["push"])
NONE = torch.zeros(0, 1), torch.zeros(0, 1)


def slide(theta, action):
    return theta * action


@pytest.mark.parametrize(
    ("call", "wrong", "meant"),
    [
        (CampaignOptions, "num_simulation", "num_simulations"),
        (lambda **k: Campaign(slide, PRIOR, ACTIONS, **k), "metod", "method"),
        (lambda **k: InformationGainDesigner(ACTIONS, **k), "estimators", "estimator"),
        (lambda **k: SimulatorModel(slide, **k), "noize", "noise"),
        (lambda **k: Trials([0.0], [0.0], **k), "sample_time", "sample_times"),
        (lambda **k: from_mjcf("", {}, **k), "sensor", "sensors"),
        (Rule, "chances", "chance"),
        (Workers, "num_worker", "num_workers"),
    ],
)
def test_a_mistyped_keyword_is_told_with_the_one_that_was_meant(call, wrong, meant):
    with pytest.raises(TypeError, match=f"got '{wrong}'; did you mean '{meant}'"):
        call(**{wrong: None})
