"""Effects by tables in Markdown: a row each, with the sizes that scale its prior."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, HalfNormal, Independent, Normal, Uniform

from sbi_active.criticism.effects.effect import Effect
from sbi_active.expected import did_you_mean, require

Patterns = str | Iterable[str]
Sizes = Mapping[str, Any]  # by name
Words = Mapping[str, str]  # in braces, by name


def picked(
    effects: Sequence[Effect],
    include: Patterns,
    exclude: Patterns = (),
    *,
    strict: bool = True,
) -> list[Effect]:
    """Return the effects that a pattern includes and none excludes.

    Args:
        effects: Effects of a library.
        include: Pattern of names that are kept, as in "sin*", or several.
        exclude: Patterns of names that are left out.
        strict: Whether every pattern has to fit an effect.

    Raises:
        ValueError: If a pattern fits no effect.
    """
    names = [effect.name for effect in effects]
    kept, left = set[str](), set[str]()
    for given, fitting in ((include, kept), (exclude, left)):
        for pattern in [given] if isinstance(given, str) else given:
            found = {name for name in names if fnmatchcase(name, pattern)}
            expected = f"patterns of names as in {names[0]!r}"
            advice = did_you_mean(pattern, names, "correct it")
            got = f"{pattern!r}, which matches none"
            require(bool(found) or not strict, expected, got, advice)
            fitting |= found
    return [e for e in effects if e.name in kept - left]


#: A factor of a formula such as "0.1 position / load^2".
FACTOR = re.compile(r"(/?) *([\w.-]+)\^?(\d?)")


@dataclass(frozen=True, kw_only=True)
class Row:
    """An effect that elements of a kind may have; its columns are text.

    Attributes:
        of: Kind of element.
        effect: Name of the effect, with that of the element in braces.
        changes: What it changes.
        prior: Kind of the prior of phi.
        size: Formula of its size, or several apart by commas.
        unit: Unit of phi.
        sentence: Sentence for reports.
        family: Family of the effect; "" takes the hook.
    """

    of: str
    effect: str
    changes: str
    prior: str
    size: str
    unit: str
    sentence: str
    family: str = ""

    def made(self, label: str, sizes: Sizes, words: Words, **options: Any) -> Effect:
        """Return the effect of an element.

        Args:
            label: Name of the element.
            sizes: Sizes that the prior is scaled by, by name.
            words: Words in braces, by name.
            **options: Hook, ``apply`` and further options of :class:`.Effect`.
        """
        has_unit = words or "{" not in self.unit
        return Effect(
            self.effect.format(label, **words).strip(),
            prior=prior_of(self.prior, self.size, sizes),
            null=torch.inf if "limit" in self.prior else 0.0,
            units=self.unit.format(**words) if has_unit else "",
            family=self.family or None,
            describe=self.sentence.format(label, **words),
            **options,
        )

    def is_sized(self, sizes: Sizes) -> bool:
        """Return whether all sizes of the prior are known."""
        names = [name for _, name, _ in FACTOR.findall(self.size)]
        return all(name in sizes or name[0].isdigit() for name in names)


@cache
def rows_of(table: Path) -> tuple[Row, ...]:
    """Return the rows of a table."""
    lines = table.read_text(encoding="utf-8").splitlines()
    cells = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in lines
        if line.startswith("|")
    ]
    columns, _, *rows = cells
    return tuple(Row(**dict(zip(columns, row, strict=True))) for row in rows)


def prior_of(kind: str, formulas: str, sizes: Sizes) -> Distribution:
    """Return a prior, of as many numbers as its formulas have.

    Args:
        kind: Kind of the prior.
        formulas: Formula of its size, or several apart by commas.
        sizes: Sizes in the formulas, numbers or shape (k,), by name.
    """
    numbers = [_number(formula, sizes) for formula in formulas.split(",")]
    if "limit" in kind:
        low, high = (n.log() for n in numbers) if "log" in kind else numbers
        return Independent(Uniform(low, high), 1)
    size = torch.cat(numbers)
    if kind == "half":
        return Independent(HalfNormal(size), 1)
    # Zero where nothing is known of the noise yet; Pyro turns the check of it on.
    one = Normal(torch.zeros_like(size), size, validate_args=False)
    return Independent(one, 1, validate_args=False)


def _number(formula: str, sizes: Sizes) -> Tensor:
    """Return the value of a product, as in "0.1 position / load^2", shape (k,)."""
    value = 1.0
    for slash, name, power in FACTOR.findall(formula):
        factor = (sizes[name] if name in sizes else float(name)) ** int(power or 1)
        value = value / factor if slash else value * factor
    return torch.as_tensor(value, dtype=torch.float64).reshape(-1)
