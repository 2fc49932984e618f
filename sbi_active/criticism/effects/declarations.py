"""What a declared effect must be before anything is computed with it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import forked_generators

if TYPE_CHECKING:
    from sbi_active.criticism.effects.effect import Effect

__all__ = [
    "require_distinct",
    "require_finite_draws",
    "require_nested",
    "require_parts",
    "sound_null",
]

#: Draws of a prior that must be finite, and that lead from the null into its support.
NUM_DRAWS = 64
#: Step from the null towards a draw: a null on the edge of a support belongs to it.
STEP = 1e-6


def require_parts(effect: Effect) -> None:
    """Raise where a part of an effect is of another type than it should be."""
    texts = {"name": effect.name, "units": effect.units}
    texts |= {
        name: value
        for name in ("family", "describe")
        if (value := getattr(effect, name)) is not None
    }
    for part, value in texts.items():
        if not isinstance(value, str):
            raise ValueError(
                f"expected {part} of an effect as text; got {value!r}; pass a string"
            )
    if not effect.name or " + " in effect.name:
        raise ValueError(
            f"expected a name without ' + ', which joins names; got {effect.name!r}; "
            "do choose another"
        )
    if not isinstance(effect.prior, Distribution):
        raise ValueError(
            f"expected a torch distribution as prior of effect {effect.name!r}; got "
            f"{effect.prior!r}; pass for example Normal(0.0, 1.0)"
        )
    if not callable(effect.apply):
        raise ValueError(
            f"expected apply of effect {effect.name!r} as a function of (value, phi, "
            f"action, context); got {effect.apply!r}; pass one"
        )


def sound_null(effect: Effect) -> Any:
    """Return the null, a copy where it is an array, or raise where it is none."""
    try:
        null = torch.as_tensor(effect.null, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"expected a null of effect {effect.name!r} in numbers; got "
            f"{effect.null!r}; pass the value of phi at which it vanishes"
        ) from error
    if null.numel() not in (1, effect.phi_dim):
        raise ValueError(
            f"expected a null of shape ({effect.phi_dim},), the shape of a draw of "
            f"effect {effect.name!r}; got {tuple(null.shape)}; do give one each"
        )
    if bool(null.isnan().any()):
        raise ValueError(
            f"expected a null of effect {effect.name!r}; got NaN; pass the value of "
            "phi at which it vanishes, which may be infinite"
        )
    return copy.deepcopy(effect.null)


def require_finite_draws(effect: Effect) -> None:
    """Raise where the prior gives phi that is no number."""
    lost = ~_draws(effect).isfinite()
    if bool(lost.any()):
        raise ValueError(
            f"expected finite draws from the prior of effect {effect.name!r}; got NaN "
            f"or inf in {int(lost.any(-1).sum())} of {NUM_DRAWS}; pass a prior whose "
            "draws are numbers"
        )


def require_nested(effects: Sequence[Effect]) -> None:
    """Raise where a prior excludes the null, so that no phi is close to no effect.

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


def require_distinct(effects: Sequence[Effect], parameters: Sequence[str] = ()) -> None:
    """Raise where two numbers would have one name in tables and records.

    Args:
        effects: By their own names, and those of the entries of their phi.
        parameters: Names of the simulator's own.
    """
    _require_once([effect.name for effect in effects], "effects with distinct names")
    shown = [effect for effect in effects if effect.scope == "campaign"]
    entries = [name for effect in shown for name in effect.phi_names]
    _require_once(
        [*parameters, *entries], "effects named unlike parameters and entries of phi"
    )


def _require_once(names: Sequence[str], expected: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"expected {expected}; got {', '.join(twice)} more than once; do rename "
            "one of them"
        )


def _reaches_null(effect: Effect) -> bool:
    draws = _draws(effect)
    null = effect.null_phi(NUM_DRAWS)
    known = null.isfinite()
    near = torch.where(known, null + STEP * (draws - null), draws)
    exact = torch.where(known, null, draws)
    return bool((effect.log_prob(torch.cat([exact, near])) > -torch.inf).any())


def _draws(effect: Effect) -> Tensor:
    with forked_generators(0, "declared"):
        return effect.sample(NUM_DRAWS)


def _in_words(effect: Effect) -> str:
    null = effect.null
    return str(null.tolist()) if torch.is_tensor(null) else f"{null}"
