"""Small effects that tests of several rooms share."""

import torch
from torch.distributions import Independent, Normal

from sbi_active.criticism import Effect


def normal(sd=1.0):
    return Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)


def effect(name="bias", **changes):
    """Return an effect that is added to outcomes, or what changes make of it."""
    parts = {
        "hook": "observation",
        "prior": normal(),
        "null": 0.0,
        "apply": lambda x, phi, action, context: x + phi,
    }
    return Effect(name, **(parts | changes))


def on_outcomes(name, apply, sd=1.0):
    """Return an effect on outcomes, of one strength that is normal about zero."""
    return effect(name, apply=apply, prior=normal(sd))


BIAS = effect()
