"""Checks of declared effects before anything is computed with them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from sbi_active.criticism.effects.effect import NUM_DRAWS, Effect


def require_nested(effects: Sequence[Effect]) -> None:
    """Raise if a prior excludes the null, so that no phi is close to no effect.

    The edge of a support counts as within, and so does an infinite null. Nuisances of
    each trial are always there and need none.
    """
    for effect in effects:
        if effect.scope == "campaign" and not _reaches_null(effect):
            raise ValueError(
                f"expected a prior of effect {effect.name!r} that allows its null "
                f"{_in_words(effect)}, at which it vanishes; got {effect.prior}; "
                "pass a prior whose support includes the null, or correct the null"
            )


def require_kind(effects: Sequence[Effect]) -> None:
    """Raise a TypeError if effects are none, as where their names are given."""
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"expected effects of class Effect; got {effect!r:.80}; pass "
                "Effect(...), or those of generic_effects(...)"
            )


def require_distinct(effects: Sequence[Effect], parameters: Sequence[str] = ()) -> None:
    """Raise if two numbers would have one name in tables and records.

    Args:
        effects: Effects by their own names, whose parts between " + " must not come
            again either, since that joins names, and those of the entries of their phi.
        parameters: Names of the simulator's own.
    """
    require_kind(effects)
    parts = [part for effect in effects for part in effect.name.split(" + ")]
    _require_once(parts, "effects with distinct names")
    shown = [effect for effect in effects if effect.scope == "campaign"]
    entries = [name for effect in shown for name in effect.phi_names]
    _require_once(
        [*parameters, *entries], "effects named unlike parameters and entries of phi"
    )


def _require_once(names: Sequence[str], expected: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"expected {expected}; got {', '.join(twice)} more than once; rename "
            "one of them"
        )


def _reaches_null(effect: Effect) -> bool:
    """Return whether the prior allows the null; on the edge of a support it does."""
    draws = effect.declared_draws()
    null = effect.null_phi(NUM_DRAWS)
    known = null.isfinite()
    near = torch.where(known, null + 1e-6 * (draws - null), draws)
    exact = torch.where(known, null, draws)
    return bool((effect.log_prob(torch.cat([exact, near])) > -torch.inf).any())


def _in_words(effect: Effect) -> str:
    null = effect.null
    return str(null.tolist()) if torch.is_tensor(null) else f"{null}"
