"""Effects: named, parameterized extensions of a simulator, and checks of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import measured
from sbi_active.expected import require, suggests
from sbi_active.inference.beliefs.priors import is_discrete
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import at_rows
from sbi_active.support import parts_of, support_of

Hook = Literal["action", "input", "parameter", "dynamics", "observation", "noise"]
SCOPES = ("campaign", "trial")

#: Stands for an infinite null where the formula has no limit in floating point.
LARGE = 1e9
#: Draws of a prior that must be finite, and that lead from the null into its support.
NUM_DRAWS = 64


@dataclass(frozen=True)
class Context:
    """Conditions of the rows that an effect changes.

    Attributes:
        index: Place of each row's trial in the order of the trials, shape (n,).
        times: Sample times, shape (k,) or (n, k); None for x without a time axis.
        inputs: Inputs as commanded, {name: (n, m)}; None for trials without.
        input_times: Uniform grid of the inputs, shape (m,).
        start: Measured start states, {name: (n,)}; None for none.
    """

    index: Tensor
    times: Tensor | None = None
    inputs: dict[str, Tensor] | None = None
    input_times: Tensor | None = None
    start: dict[str, Tensor] | None = None

    def at(self, rows: slice) -> Context:
        """Return the context of some rows."""
        known = at_rows(vars(self), rows)
        if self.times is not None and self.times.ndim == 1:
            known["times"] = self.times  # of every row
        return Context(**known)

    def told(self, names: Iterable[str]) -> dict[str, Any]:
        """Return those of some conditions that are known, times in each row."""
        known = vars(self)
        if self.times is not None:
            known = known | {"times": self.times.expand(len(self.index), -1)}
        return {name: known[name] for name in names if known[name] is not None}


@suggests
@dataclass(frozen=True)
class Effect:
    r"""A nested extension of a simulator that vanishes at :math:`\phi = \phi_0`.

    Args:
        name: Name in reports; unique among the effects of a loop.
        hook: Part that it changes: the "action" that is executed, the "input" series,
            the "parameter" vector theta, the keyword arguments of the simulator's
            function ("dynamics"), the "observation" x, or the standard deviation of the
            "noise".
        prior: Distribution of phi, with event or batch shape (phi_dim,) or ().
        null: Value of phi, a number or shape (phi_dim,), at which the effect vanishes;
            may be infinite.
        apply: ``apply(value, phi, action, context) -> value`` on rows: phi is
            (n, phi_dim), action (n, action_dim) as commanded, ``context`` a
            :class:`Context`. For "input", value is {name: (n, m)}, on the grid
            ``context.input_times``. For "dynamics", it is a dict of keyword arguments.
            For "noise", it is the standard deviation, of the shape of x.
        units: Units of phi.
        family: Name of the family. Effects of one family share a prior probability, so
            that variants of an idea do not dilute others; None takes the hook.
        scope: "campaign" for one phi in all trials; "trial" for a nuisance that every
            trial draws afresh and every rival model marginalizes.
        describe: A sentence for the report.
        needs_order: Whether it acts by ``context.index``, the order of the trials; it
            is then left out if that is unknown.

    Raises:
        ValueError: If the hook or scope is unknown, a part is of another type, null and
            prior have different sizes, the null is NaN, or draws of phi are not finite.

    Example:
        >>> from torch.distributions import Normal
        >>> bias = Effect(
        ...     "bias", hook="observation", prior=Normal(0.0, 2.0), null=0.0,
        ...     apply=lambda x, phi, action, context: x + phi, units="m",
        ... )
        >>> bias.phi_dim, bias.family
        (1, 'observation')
    """

    name: str
    hook: Hook
    prior: Distribution
    null: float | Tensor
    apply: Callable[[Any, Tensor, Tensor, Context], Any]
    units: str = ""
    family: str | None = None
    scope: Literal["campaign", "trial"] = "campaign"
    describe: str | None = None
    needs_order: bool = False

    def __post_init__(self) -> None:
        _require_parts(self)
        object.__setattr__(self, "null", _sound_null(self))
        if self.family is None:
            object.__setattr__(self, "family", self.hook)

    def __repr__(self) -> str:
        unit = f" [{self.units}]" if self.units else ""
        scope = ", a trial's own" if self.scope == "trial" else ""
        return f"Effect({self.name}{unit}, of the {self.hook}{scope})"

    @classmethod
    def keyword(
        cls, name: str, *keywords: str, prior: Distribution, **options: Any
    ) -> Effect:
        """Return an effect that the simulator's function already has.

        Args:
            name: Name of the effect.
            *keywords: Arguments of the simulator's function, one an entry of phi, each
                of shape (n,); without any the name, its spaces underscored.
            prior: Prior of phi.
            **options: Options of the constructor; the null is 0 unless given.

        Raises:
            ValueError: If there is not one keyword for each entry of phi.

        Example:
            >>> from torch.distributions import HalfNormal
            >>> drag = Effect.keyword("drag", prior=HalfNormal(0.3), units="1/m")
            >>> drag.hook, drag.null
            ('dynamics', 0.0)
        """
        names = keywords or (name.replace(" ", "_"),)
        options = {"null": 0.0, **options}
        effect = cls(
            name, hook="dynamics", prior=prior, apply=_Keywords(names), **options
        )
        expected = f"{effect.phi_dim} keywords for effect {name!r}, one an entry of phi"
        same = len(names) == effect.phi_dim
        require(same, expected, ", ".join(names), "name each")
        return effect

    @property
    def phi_dim(self) -> int:
        """Number of parameters of the effect."""
        return max((self.prior.batch_shape + self.prior.event_shape).numel(), 1)

    @property
    def phi_names(self) -> list[str]:
        """One name an entry of phi."""
        if self.phi_dim == 1:
            return [self.name]
        return [f"{self.name}_{i + 1}" for i in range(self.phi_dim)]

    def sample(self, num: int) -> Tensor:
        """Return draws of phi by torch's generator, shape (num, phi_dim), float64."""
        return self.prior.sample(torch.Size([num])).double().reshape(num, self.phi_dim)

    def declared_draws(self) -> Tensor:
        """Return the same few draws of phi each time, shape (64, phi_dim), float64."""
        with forked_generators(0, "declared"):
            return self.sample(NUM_DRAWS)

    def log_prob(self, phi: Tensor) -> Tensor:
        """Return the log prior density, shape (n,), float64; -inf outside."""
        return log_density_within(self.prior, phi).double()

    def null_phi(self, num: int, *, finite: bool = False) -> Tensor:
        """Return the null in each row, shape (num, phi_dim), float64."""
        null = torch.as_tensor(self.null, dtype=torch.float64).reshape(-1)
        if finite:
            null = torch.nan_to_num(null, posinf=LARGE, neginf=-LARGE)
        return null.expand(self.phi_dim).repeat(num, 1)


def log_density_within(prior: Distribution, rows: Tensor) -> Tensor:
    """Return log densities of rows (n, k), -inf outside, shape (n,), with gradients.

    Outside of its support a distribution raises or gives what it likes.
    """
    shape = prior.batch_shape + prior.event_shape
    value = rows.reshape(len(rows), *shape)
    inside = support_of(prior).check(value)[:, None].flatten(1).all(-1)
    with forked_generators(0, "inside"):
        some = prior.sample()
    safe = torch.where(inside.reshape(-1, *[1] * len(shape)), value, some)
    density = prior.log_prob(safe)[:, None].flatten(1).sum(-1)
    return density.where(inside, -torch.inf)


@dataclass(frozen=True)
class _Keywords:
    """Hands phi to the simulator's function."""

    names: tuple[str, ...]

    def __call__(
        self, value: dict[str, Any], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Any]:
        return {**value, **dict(zip(self.names, phi.unbind(-1), strict=True))}


def _require_parts(effect: Effect) -> None:
    """Raise if a part of an effect is none, or of another type than it should be."""
    own = f"of effect {effect.name!r}"
    texts = [effect.name, effect.units, effect.family or "", effect.describe or ""]
    is_text = all(isinstance(text, str) for text in texts) and bool(effect.name)
    require(is_text, f"name, units, family and describe {own}", texts, "pass strings")
    is_prior = isinstance(effect.prior, Distribution) and not any(
        is_discrete(part) for part in parts_of(effect.prior.support)
    )
    advice = "pass for example Normal(0.0, 1.0), and one effect for each value of a "
    advice += "discrete quantity"
    require(is_prior, f"a continuous torch prior {own}", effect.prior, advice)
    expected = f"apply {own} as a function of (value, phi, action, context)"
    require(callable(effect.apply), expected, repr(effect.apply), "pass one")
    for part, known in (("hook", get_args(Hook)), ("scope", SCOPES)):
        value = getattr(effect, part)
        expected = f"{part} among {', '.join(map(repr, known))}"
        require(value in known, expected, repr(value), "choose one of these")


def _sound_null(effect: Effect) -> Any:
    """Return the null, a copy where it is an array, or raise where it is none."""
    own, advice = f"of effect {effect.name!r}", "pass the value at which it vanishes"
    null = measured(effect.null, name=f"null {own}")
    is_null = null.numel() in (1, effect.phi_dim) and not bool(null.isnan().any())
    expected = f"a null {own} of shape ({effect.phi_dim},), that of a draw"
    require(is_null, expected, null.tolist(), advice)
    lost = int((~effect.declared_draws().isfinite()).any(-1).sum())
    got = f"NaN or inf in {lost} of {NUM_DRAWS}"
    advice = "pass a prior whose draws are numbers"
    require(lost == 0, f"finite draws from the prior {own}", got, advice)
    return copy.deepcopy(effect.null)


@dataclass(frozen=True)
class UnderKey:
    """Adds phi to a dictionary that the simulator takes as a keyword, under a key.

    Attributes:
        keyword: Keyword of the simulator's function.
        key: Key that phi belongs to, such as a force.
        order: Center and half span of the trials' order; with it the place of the
            trial, from -1 to 1, is the last column of phi.
    """

    keyword: str
    key: Any
    order: tuple[float, float] | None = None

    def __call__(
        self, value: dict[str, Any], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Any]:
        """Return the keywords with phi added."""
        if self.order is not None:
            center, half = self.order
            place = (context.index.to(phi) - center) / half
            phi = torch.cat([phi, place[:, None]], 1)
        others = value.get(self.keyword) or {}
        return {**value, self.keyword: {**others, self.key: phi}}


def require_nested(effects: Sequence[Effect]) -> None:
    """Raise if a prior excludes the null, so that no phi is close to no effect.

    The edge of a support counts as within, and so does an infinite null. Nuisances of
    each trial are always there and need none.
    """
    for effect in effects:
        draws, null = effect.declared_draws(), effect.null_phi(NUM_DRAWS)
        near = [null + step * (draws - null) for step in (0.0, 1e-6)]
        rows = torch.cat([part.where(null.isfinite(), draws) for part in near])
        reaches = bool((effect.log_prob(rows) > -torch.inf).any())
        require(
            effect.scope == "trial" or reaches,
            f"a prior of effect {effect.name!r} that allows its null {effect.null}, at "
            "which it vanishes",
            effect.prior,
            "pass a prior whose support includes the null, or correct the null",
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
    shown = [effect for effect in effects if effect.scope == "campaign"]
    entries = [name for effect in shown for name in effect.phi_names]
    for names, expected in (
        (parts, "effects with distinct names"),
        ([*parameters, *entries], "effects named unlike parameters and entries of phi"),
    ):
        twice = ", ".join(sorted({name for name in names if names.count(name) > 1}))
        require(not twice, expected, f"{twice} more than once", "rename one of them")
