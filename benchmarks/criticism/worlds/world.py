"""What a world is: a simulator, what it may lack, and what it certainly lacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    HalfNormal,
    Independent,
    MixtureSameFamily,
    Normal,
    Uniform,
)

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Effect
from sbi_active.criticism.effects.effect import Hook


@dataclass(frozen=True, kw_only=True)
class World:
    """A bare simulator with declared noise, and effects that real data may have.

    Attributes:
        name: One letter.
        model: The bare simulator, with the noise that is declared to the loop.
        prior: Of theta.
        actions: The permitted ones.
        noise_sd: Of the real system, in the units of x.
        library: Function of the effects declared to the loop.
        scatter: Noise inflation, which is not an effect of the library.
        outside: Effects that the library lacks; their priors are the distributions of
            their strengths.
        equivalences: Names of effects ("none" included) that no action of this world
            separates.
        aliases: Effects outside the library, by name, with those inside that come
            near.
        formulas: Effects whose exact form is one term c g(action) or c g(x), by name,
            with the names of that term.
        correlations: Of neighboring errors along a trajectory; a case draws one.
        sample_times: Of the entries of x, s; empty without a time axis.
        hidden: Names of the effects of the library that cases of that kind have, in
            turn; none has any of the library or noise inflation, at random.
        is_rough: Whether the simulator jumps, so that derivatives lead nowhere. The
            model that is given the true effect, which needs them, is then not scored.
    """

    name: str
    model: SimulatorModel
    prior: BoxUniform
    actions: DiscreteActions
    noise_sd: float
    library: Callable[[], list[Effect]]
    scatter: Effect
    outside: Sequence[Effect]
    equivalences: Sequence[frozenset[str]] = ()
    aliases: Mapping[str, frozenset[str]] = field(default_factory=dict)
    formulas: Mapping[str, frozenset[str]] = field(default_factory=dict)
    correlations: Sequence[float] = (0.0,)
    sample_times: Sequence[float] = ()
    hidden: Sequence[str] = ()
    is_rough: bool = False

    @property
    def effects(self) -> list[Effect]:
        """The declared library with the priors that the truth is drawn from."""
        return self.library()

    def equivalent(self, name: str) -> frozenset[str]:
        """Return the names that count as one with a name, itself included."""
        groups = [group for group in self.equivalences if name in group]
        return frozenset({name}).union(*groups)


def shifted(x: Tensor, phi: Tensor, action: Any, context: Any) -> Tensor:
    """Return a value with phi added."""
    return x + phi


def stretched(x: Tensor, phi: Tensor, action: Any, context: Any) -> Tensor:
    """Return a value with the relative error phi."""
    return x * (1 + phi)


def drifted(x: Tensor, phi: Tensor, action: Any, context: Any) -> Tensor:
    """Return a value with phi added for each trial before."""
    return x + phi * context.index[:, None]


def effect(
    name: str,
    hook: Hook,
    prior: Distribution,
    apply: Callable[..., Tensor],
    *,
    units: str = "",
    null: float = 0.0,
) -> Effect:
    """Return an effect on a value, with the strength at which it vanishes."""
    return Effect(name, hook=hook, prior=prior, null=null, apply=apply, units=units)


def noise_inflation(sd: float) -> Effect:
    """Return scatter: noise that is larger than declared."""
    return effect("noise inflation", "noise", half_normal(sd), stretched)


def normal(sd: float) -> Distribution:
    """Return N(0, sd^2) over one number, event shape (1,)."""
    return Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)


def half_normal(sd: float) -> Distribution:
    """Return |N(0, sd^2)| over one number, event shape (1,)."""
    return Independent(HalfNormal(torch.full((1,), sd)), 1)


def uniform(low: float, high: float) -> Distribution:
    """Return U(low, high) over one number, event shape (1,)."""
    return BoxUniform(torch.full((1,), low), torch.full((1,), high))


def signed_uniform(low: float, high: float) -> Distribution:
    """Return +-U(low, high), either sign as likely, event shape (1,)."""
    parts = Uniform(torch.tensor([[-high, low]]), torch.tensor([[-low, high]]))
    return Independent(MixtureSameFamily(Categorical(torch.ones(1, 2)), parts), 1)
