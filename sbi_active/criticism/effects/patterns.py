"""Effects of a library that are picked by patterns of their names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from sbi_active.criticism.effects.effect import Effect


def as_patterns(given: str | Iterable[str]) -> list[str]:
    """Return a list of patterns, of one or of several."""
    return [given] if isinstance(given, str) else [*given]


def unmatched(effects: Iterable[Effect], patterns: Sequence[str]) -> list[str]:
    """Return the patterns that fit no effect."""
    names = [e.name for e in effects]
    return [p for p in patterns if not any(fnmatchcase(n, p) for n in names)]


def picked(
    effects: Iterable[Effect], include: Sequence[str], exclude: Sequence[str]
) -> list[Effect]:
    """Return the effects that a pattern includes and none excludes."""
    return [
        e
        for e in effects
        if any(fnmatchcase(e.name, p) for p in include)
        and not any(fnmatchcase(e.name, p) for p in exclude)
    ]
