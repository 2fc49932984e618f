"""Small effects, and readings with an error, that tests of several rooms share."""

import torch
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active.criticism import Effect


def normal(sd=1.0):
    return Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)


def half(sd=1.0):
    return Independent(HalfNormal(torch.full((1,), sd)), 1)


def effect(name="bias", **changes):
    """Return an effect that is added to outcomes, or what changes make of it."""
    parts = {
        "hook": "observation",
        "prior": normal(),
        "null": 0.0,
        "apply": lambda x, phi, action, context: x + phi,
    }
    return Effect(name, **(parts | changes))


def on_outcomes(name, apply, sd=1.0, **changes):
    """Return an effect on outcomes, of one strength that is normal about zero."""
    return effect(name, apply=apply, **({"prior": normal(sd)} | changes))


def added(name, form, sd=1.0, **changes):
    """Return an effect that adds its strength times a form of the action to x."""

    def apply(x, phi, action, context):
        return x + phi * form(action.to(x))

    return on_outcomes(name, apply, sd, **changes)


def drift(sd=1.0, **changes):
    """Return an effect that adds its strength from trial to trial."""

    def apply(x, phi, action, context):
        return x + phi * context.index[:, None]

    return on_outcomes("drift", apply, sd, **changes)


def gain(sd=1.0):
    """Return an effect that makes outcomes larger by a share."""
    return on_outcomes("gain", lambda x, phi, *_: x * (1 + phi), sd)


def louder(by=lambda phi, action: phi[:, :1], sd=1.0):
    """Return an effect that makes the noise larger by a share."""

    def apply(scale, phi, action, context):
        return scale * (1 + by(phi, action))

    return effect("louder", hook="noise", prior=half(sd), apply=apply)


def with_error(mean, sd, seed=0):
    """Return what a sensor of some error reads of a mean, by a seed or a generator."""
    gen = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
    return mean + sd * torch.randn(mean.shape, generator=gen)


def autocorrelated(e, rho):
    """Make errors last along axis 1, in place: each is rho of the one before."""
    for k in range(1, e.shape[1]):
        e[:, k] = rho * e[:, k - 1] + (1 - rho**2) ** 0.5 * e[:, k]
    return e


BIAS = effect()
