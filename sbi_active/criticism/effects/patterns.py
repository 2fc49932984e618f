"""Effects of a library that are picked by patterns of their names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from sbi_active.criticism.effects.effect import Effect
from sbi_active.expected import did_you_mean, require

Patterns = str | Iterable[str]


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
    kept, left = (
        [given] if isinstance(given, str) else [*given] for given in (include, exclude)
    )
    names = [effect.name for effect in effects]
    for pattern in [*kept, *left] if strict else ():
        require(
            any(fnmatchcase(name, pattern) for name in names),
            f"patterns of names as in {names[0]!r}",
            f"{pattern!r}, which matches none",
            did_you_mean(pattern, names, "correct it"),
        )

    def fits(name: str, patterns: list[str]) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in patterns)

    return [e for e in effects if fits(e.name, kept) and not fits(e.name, left)]
