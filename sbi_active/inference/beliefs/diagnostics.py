"""Trustworthiness of a belief, and the figures behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from sbi_active.display.notebook import badge, card, facts, items
from sbi_active.display.table import number
from sbi_active.identifiability.known import Combinations
from sbi_active.messages import Message, warn

VERDICTS = {
    True: ("good", "trustworthy"),
    False: ("bad", "not trustworthy"),
    None: ("plain", "not checked"),
}


@dataclass(frozen=True)
class Assumption:
    """An assumption of a method, and how it was checked.

    Attributes:
        holds: Whether it may be relied on.
        figure: Figure that it was judged by.
    """

    holds: bool
    figure: float


@dataclass(frozen=True, kw_only=True)
class Diagnostics:
    """Diagnostics of a belief's quality.

    ``print(belief.diagnostics)`` reports them in words.

    Attributes:
        trustworthy: Whether the belief passed all checks; None if nothing was checked.
        warnings: Warnings about the belief with advice, a sentence each.
        network_warnings: Warnings of the amortized network beside a refined belief.
        assumptions: Assumptions by name, each with the figure that it was judged by.
        num_simulations: Rows that the belief cost.
        num_missing: Number of those simulations lost to faults of the simulator.
        effective_sample_size: Effective number of the weighted draws behind it.
        error_nats: Expected divergence from the belief of endless simulations.
        error_nats_if_explained: Expected divergence if the observations were as
            simulations are.
        tail_probability: Probability that a simulation from the belief lies as far out
            as all trials together do.
        tail_probability_of_trial: Tail probability of each trial alone.
        combinations: Combinations that are known of parameters not known one by one,
            and what is not; says nothing where each is.
        figures: Further figures, by the method; each is an attribute as well.
    """

    trustworthy: bool | None = None
    warnings: tuple[str, ...] = ()
    network_warnings: tuple[str, ...] = ()
    assumptions: Mapping[str, Assumption] = field(default_factory=dict)
    num_simulations: int = 0
    num_missing: int = 0
    effective_sample_size: float | None = None
    error_nats: float | None = None
    error_nats_if_explained: float | None = None
    tail_probability: float | None = None
    tail_probability_of_trial: tuple[float, ...] = ()
    combinations: Combinations = Combinations()
    figures: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("warnings", "network_warnings"):
            texts = tuple(map(Message, getattr(self, name)))
            object.__setattr__(self, name, texts)

    def extended(self, **changes: Any) -> Diagnostics:
        """Return these with other values; names that are no field become figures."""
        names = {f.name for f in fields(self)}
        own = {name: value for name, value in changes.items() if name in names}
        further = {n: value for n, value in changes.items() if n not in names}
        return replace(self, **own, figures={**self.figures, **further})

    def warned(self, *texts: str) -> Diagnostics:
        """Return these with further warnings, no longer trustworthy with any."""
        if not texts:
            return self
        return replace(self, trustworthy=False, warnings=(*self.warnings, *texts))

    def to_dict(self) -> dict[str, Any]:
        """Return all that is known, in a form that JSON can hold."""
        known: dict[str, Any] = {
            f.name: getattr(self, f.name) for f in fields(self) if f.name != "figures"
        }
        known["assumptions"] = {
            name: {"holds": a.holds, "figure": a.figure}
            for name, a in self.assumptions.items()
        }
        for name in ("warnings", "network_warnings", "tail_probability_of_trial"):
            known[name] = [*known[name]]
        known["combinations"] = self.combinations.to_dict()
        known |= self.figures
        containers = (tuple, list, dict)
        return {
            name: value
            for name, value in known.items()
            if value is not None and not (isinstance(value, containers) and not value)
        }

    def _pairs(self) -> list[tuple[str, Any]]:
        """Return what is known by what it is; None or "" where it is not."""
        broken = [name for name, a in self.assumptions.items() if not a.holds]
        return [
            ("assumptions that do not hold", ", ".join(broken)),
            ("parameters", str(self.combinations) if self.combinations else None),
            ("simulations", self.num_simulations or None),
            ("lost of them", self.num_missing or None),
            ("effective draws", number(self.effective_sample_size)),
            ("off by [nats]", number(self.error_nats)),
            ("tail probability of the trials", number(self.tail_probability)),
        ]

    def __str__(self) -> str:
        texts = (*self.warnings, *self.network_warnings)
        lines = [VERDICTS[self.trustworthy][1], *(f"- {text}" for text in texts)]
        return "\n".join([*lines, *(f"{k}: {v}" for k, v in self._pairs() if v)])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        kind, verdict = VERDICTS[self.trustworthy]
        texts = (*self.warnings, *self.network_warnings)
        pairs = [(k, v or None) for k, v in self._pairs()]
        return card(badge(verdict, kind), items(texts), facts(pairs))

    def __getattr__(self, name: str) -> Any:
        figures = self.__dict__.get("figures", {})
        if name not in figures:
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
        return figures[name]

    def __getitem__(self, name: str) -> Any:
        known = self._as_dict(f"[{name!r}]")
        # A list without entries is left out of a dict, and is no unknown name.
        return [] if getattr(self, name, None) == () else known[name]

    def __contains__(self, name: object) -> bool:
        return name in self._as_dict(f".__contains__({name!r})")

    def get(self, name: str, default: Any = None) -> Any:
        """Return an entry by its name, as of a dict (deprecated)."""
        return self._as_dict(f".get({name!r})").get(name, default)

    def _as_dict(self, used: str) -> dict[str, Any]:
        warn(f"SA701 diagnostics{used} is deprecated; use an attribute, or to_dict()")
        return self.to_dict()
