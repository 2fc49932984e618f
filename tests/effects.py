"""Small effects that tests of several rooms share."""

import torch
from torch.distributions import Independent, Normal

from sbi_active.criticism import Effect


def on_outcomes(name, apply, sd=1.0):
    """Return an effect on outcomes, of one strength that is normal about zero."""
    prior = Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)
    return Effect(name, hook="observation", prior=prior, null=0.0, apply=apply)


BIAS = on_outcomes("bias", lambda x, phi, action, context: x + phi)
