"""An effect's ``apply`` on rows: what it gets, and what it may give back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.expected import require
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
    own = Context(**copied(vars(context)))
    changed = effect.apply(copied(value), phi.clone(), action.clone(), own)
    if not isinstance(value, Mapping):
        return _numbers(effect, value, changed, effect.hook)
    is_input = effect.hook == "input"
    known = {*changed} if isinstance(changed, Mapping) else None
    kind = f"the inputs {', '.join(value)}" if is_input else "keyword arguments"
    require(
        known is not None and (not is_input or known <= {*value}),
        f"apply of effect {effect.name!r} to return a dict of {kind}",
        type(changed).__name__ if known is None else ", ".join(known),
        "return {**value, name: phi}",
    )
    if not is_input:
        return {**changed}
    return {  # inputs that are left out are not changed
        name: _numbers(effect, part, changed.get(name, part), f"input {name!r}")
        for name, part in value.items()
    }


def _numbers(effect: Effect, value: Tensor, changed: Any, what: str) -> Tensor:
    try:
        result = torch.as_tensor(changed)
        got = f"{tuple(result.shape)} of {result.dtype}"
    except (TypeError, ValueError, RuntimeError):
        result, got = torch.empty(0, dtype=torch.bool), type(changed).__name__
    is_real = not result.is_complex() and result.dtype != torch.bool
    require(
        is_real and result.shape == value.shape,
        f"apply of effect {effect.name!r} to return the changed {what}, real numbers "
        f"of shape {tuple(value.shape)}",
        got,
        "return one row for each row, with phi of shape (n, phi_dim)",
    )
    return result.to(value.dtype, copy=True)
