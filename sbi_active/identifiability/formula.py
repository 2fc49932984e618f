"""A combination of parameters, its value and its formula in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sbi_active.arrays import Array

SIMPLE = (1.0, 2.0, 0.5, 3.0, 1.5)  # weights and exponents, the simplest first


@dataclass(frozen=True)
class Term:
    """One parameter in a combination: weight times theta, or log(theta + shift).

    Attributes:
        index: Index of the parameter.
        weight: Weight of the term, or exponent of the factor.
        log: Whether it is a factor of a product.
        shift: Shift that is added to the parameter before the logarithm.
    """

    index: int
    weight: float = 1.0
    log: bool = False
    shift: float = 0.0

    def coordinate(self, theta: Array) -> Array:
        """Return theta or its logarithm, not weighed, shape (n,)."""
        moved = theta[:, self.index] + self.shift
        return np.log(moved) if self.log else moved

    def slope(self, theta: Array) -> Array:
        """Return the derivative of the coordinate, shape (n,)."""
        moved = theta[:, self.index] + self.shift
        return 1 / moved if self.log else np.ones_like(moved)


@dataclass(frozen=True)
class Combination:
    """A sum of terms; with a logarithm among them, the product that it stands for.

    Attributes:
        terms: Terms, one a parameter.
    """

    terms: tuple[Term, ...]

    @property
    def index(self) -> tuple[int, ...]:
        """Indices of its parameters."""
        return tuple(term.index for term in self.terms)

    @property
    def weight(self) -> Array:
        """Weights of the terms."""
        return np.array([term.weight for term in self.terms])

    @property
    def is_product(self) -> bool:
        """Whether it is one, rather than a sum."""
        return any(term.log for term in self.terms)

    def coordinate(self, theta: Array) -> Array:
        """Return the sum of the terms, the logarithm of a product, (n, d) -> (n,)."""
        return sum(t.weight * t.coordinate(theta) for t in self.terms)  # pyright: ignore

    def value(self, theta: Array) -> Array:
        """Return the value of the formula, (n, d) -> (n,)."""
        sums = self.coordinate(theta)
        return np.exp(sums) if self.is_product else sums

    def text(self, names: Sequence[str], *, most: int = 4) -> str:
        """Return the formula, with the names of all parameters of the simulator.

        Args:
            names: The names.
            most: Number of terms that are written out.
        """
        part, sign = (_factor, "*") if self.is_product else (_summand, "+")
        shown = sorted(self.terms, key=lambda t: not t.log)[:most]
        text = "".join(part(t, names[t.index], i) for i, t in enumerate(shown))
        return text + f" {sign} ..." * (len(shown) < len(self.terms))

    @property
    def complexity(self) -> float:
        """Digits that it takes to write it; a sum is simpler than a product."""
        text = self.text(["x"] * (1 + max(self.index)), most=len(self.terms))
        logs = [t.log for t in self.terms]
        kind = 0.25 if all(logs) else 1.5 * any(logs)
        return kind + sum(character.isdigit() for character in text)


def linked(combinations: Sequence[Combination]) -> list[list[Combination]]:
    """Return combinations in groups, those together that share parameters."""
    groups: list[list[Combination]] = []
    for combination in combinations:
        own = {*combination.index}
        touched = [g for g in groups if any(own & {*c.index} for c in g)]
        groups = [g for g in groups if g not in touched]
        groups.append([*(c for g in touched for c in g), combination])
    groups = [sorted(group, key=lambda c: c.index) for group in groups]
    return sorted(groups, key=lambda group: group[0].index)


def _summand(term: Term, name: str, place: int) -> str:
    sign = (" + ", " - ") if place else ("", "-")
    size = abs(term.weight)
    factor = "" if size == 1 else f"{size:.4g} * "
    return f"{sign[term.weight < 0]}{factor}{name}"


def _factor(term: Term, name: str, place: int) -> str:
    if not term.log:
        factor = {1.0: "", -1.0: "-"}.get(term.weight, f"{term.weight:.4g} * ")
        return f"{' * ' if place else ''}exp({factor}{name})"
    if term.shift:
        name = f"({name} {'+' if term.shift > 0 else '-'} {abs(term.shift):.4g})"
    size = abs(term.weight)
    power = "" if size == 1 else f"^{size:.4g}"
    sign = (" * ", " / ") if place else ("", "1 / ")
    return f"{sign[term.weight < 0]}{name}{power}"
