"""Whether an effect vanishes at its null, and keeps noise what noise is."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.application import applied
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.seeding import forked_generators


def change_at_null(reference: Tensor, at_null: Any, effect: Effect) -> float:
    """Return the largest change of x at the null; inf if it turns into NaN."""
    difference = torch.inf
    is_finite = bool(effect.null_phi(1).isfinite().all())
    for finite in (True,) if is_finite else (False, True):
        null = effect.null_phi(len(reference), finite=finite).to(reference.dtype)
        x = torch.as_tensor(at_null(null))
        same = (x == reference) | (x.isnan() & reference.isnan())
        gap = (x - reference).abs().where(~same, torch.zeros_like(reference))
        if bool(gap.isfinite().all()):
            difference = min(difference, float(gap.max()))
    return difference


def require_positive(
    effect: Effect, one: Tensor, action: Tensor, context: Context
) -> None:
    """Raise if an effect on the noise makes a deviation that is none."""
    with forked_generators(0, "noise of an effect"):
        phi = effect.sample(len(one)).to(one.dtype)
    sd = applied(effect, one, phi, action, context)
    wrong = ~(sd > 0) & ~one.isnan()
    if bool(wrong.any()):
        row = int(wrong.flatten(1).any(1).nonzero()[0])
        raise ValueError(
            f"expected effect {effect.name!r} to keep the noise positive; got "
            f"{float(sd[row].min()):.3g} times its size at phi = {phi[row].tolist()}; "
            "pass a prior without such phi, or another apply"
        )
