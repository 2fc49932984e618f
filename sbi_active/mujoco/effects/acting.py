"""Effects on the model, and effects that are generalized forces."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import HalfNormal, Independent, Normal, Uniform

from sbi_active.criticism.effects.effect import Effect, UnderKey

__all__ = ["force_effect", "half_normal", "model_effect", "normal", "uniform"]


def model_effect(name: str, change: Any, *, prior: Any, **options: Any) -> Effect:
    """Return an effect that changes the model.

    Args:
        name: Name of the effect.
        change: A :class:`.ModelChange`.
        prior: Prior of phi.
        **options: Options of :class:`.Effect`; the null is 0 unless given.
    """
    options = {"null": 0.0, **options}
    return Effect(
        name, hook="dynamics", prior=prior, apply=UnderKey("model", change), **options
    )


def force_effect(name: str, force: Any, *, prior: Any, **options: Any) -> Effect:
    """Return an effect that is a generalized force.

    Args:
        name: Name of the effect.
        force: A :class:`.Force`, zero at the null.
        prior: Prior of phi.
        **options: Options of :class:`.Effect`; the null is 0 unless given.
    """
    options = {"null": 0.0, **options}
    return Effect(
        name, hook="dynamics", prior=prior, apply=UnderKey("force", force), **options
    )


def normal(sd: float) -> Independent:
    """Return a normal prior of one number around 0."""
    return Independent(Normal(_one(0.0), _one(sd)), 1)


def half_normal(sd: float, num: int = 1) -> Independent:
    """Return a half-normal prior of some numbers, independent of each other."""
    return Independent(HalfNormal(_one(sd).repeat(num)), 1)


def uniform(low: float, high: float) -> Independent:
    """Return a uniform prior of one number."""
    return Independent(Uniform(_one(low), _one(high)), 1)


def _one(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)
