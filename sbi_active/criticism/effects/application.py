"""An effect's ``apply`` on rows: what it gets, and what it may give back.

At its null it changes nothing, and it keeps noise what noise is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import copied


def applied(
    effect: Effect, value: Any, phi: Tensor, action: Tensor, context: Context
) -> Any:
    """Return a value as an effect changes it.

    The effect gets copies, so that it may change them in place, and its result is
    copied, so that it may be a view of a buffer.

    Args:
        effect: Effect of any hook.
        value: Value that the hook changes; a dict for "dynamics" and "input".
        phi: Parameters of the effect, shape (n, phi_dim).
        action: Actions as commanded, shape (n, action_dim).
        context: Context of the rows.

    Raises:
        ValueError: If ``apply`` gives back another type, shape or kind of number, or a
            standard deviation that is not positive.
    """
    own = Context(**{name: copied(part) for name, part in vars(context).items()})
    changed = effect.apply(copied(value), phi.clone(), action.clone(), own)
    if effect.hook == "dynamics":
        if isinstance(changed, Mapping):
            return {**changed}
        raise ValueError(
            f"expected apply of effect {effect.name!r} to return a dict of keyword "
            f"arguments; got {type(changed).__name__}; return {{**value, name: phi}}"
        )
    if effect.hook == "input":
        return _series(effect, value, changed)
    return _numbers(effect, value, changed, effect.hook)


def nulls(effect: Effect, like: Tensor) -> list[Tensor]:
    """Return the null in each row; one that is infinite also by a large number."""
    each = {False, not bool(effect.null_phi(1).isfinite().all())}
    return [effect.null_phi(len(like), finite=f).to(like.dtype) for f in each]


def largest_change(reference: Tensor, x: Tensor) -> float:
    """Return the largest difference of x; inf if a number turns into NaN or back."""
    same = (x == reference) | (x.isnan() & reference.isnan())
    gap = (x - reference).abs().where(~same, torch.zeros_like(reference))
    return float(gap.nan_to_num(torch.inf).max())


def require_positive(
    effect: Effect, one: Tensor, action: Tensor, context: Context
) -> None:
    """Raise if an effect on the noise makes a deviation that is none."""
    with forked_generators(0, "noise of an effect"):
        phi = effect.sample(len(one)).to(one.dtype)
    sd = applied(effect, one, phi, action, context)
    wrong = ~(sd > 0) & ~one.isnan()
    for row in wrong.flatten(1).any(1).nonzero()[:1, 0].tolist():
        raise ValueError(
            f"expected effect {effect.name!r} to keep the noise positive; got "
            f"{float(sd[row].min()):.3g} times its size at phi = {phi[row].tolist()}; "
            "pass a prior without such phi, or another apply"
        )


def _series(
    effect: Effect, value: Mapping[str, Tensor], changed: Any
) -> dict[str, Tensor]:
    """Return the changed inputs; those that are left out are not changed."""
    if not isinstance(changed, Mapping) or not {*changed} <= {*value}:
        got = [*changed] if isinstance(changed, Mapping) else type(changed).__name__
        raise ValueError(
            f"expected apply of effect {effect.name!r} to return a dict of the inputs "
            f"{', '.join(value)}; got {got}; return {{**value, name: series}}"
        )
    return {
        name: _numbers(effect, part, changed.get(name, part), f"input {name!r}")
        for name, part in value.items()
    }


def _numbers(effect: Effect, value: Tensor, changed: Any, what: str) -> Tensor:
    try:
        result = torch.as_tensor(changed)
    except (TypeError, ValueError, RuntimeError):
        result = None
    if result is None or result.shape != value.shape:
        got = type(changed).__name__ if result is None else tuple(result.shape)
        raise ValueError(
            f"expected apply of effect {effect.name!r} to return the changed "
            f"{what} of shape {tuple(value.shape)}; got {got}; return one row "
            "for each row, with phi of shape (n, phi_dim)"
        )
    if result.is_complex() or result.dtype == torch.bool:
        raise ValueError(
            f"expected apply of effect {effect.name!r} to return real numbers; got "
            f"{result.dtype}; return the changed {what}"
        )
    return result.to(value.dtype, copy=True)
