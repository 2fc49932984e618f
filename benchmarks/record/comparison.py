"""Old and new results side by side."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

#: Standard errors beyond which figures differ: by chance once in 16,000.
DIFFERENT = 4.0
#: Least standard error of a figure, relative to its size and absolutely: log evidence,
#: probabilities and actions without an error of their own.
RELATIVE, ABSOLUTE = 1e-3, 0.025

Kept = dict[str, dict[str, Any]]


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return what differs between two results of a case by more than by chance.

    Args:
        old: Figures and words of one.
        new: Those of the other.
    """
    found = [
        f"{name}: {old['words'].get(name, '-')} -> {new['words'].get(name, '-')}"
        for name in sorted({*old["words"], *new["words"]})
        if old["words"].get(name) != new["words"].get(name)
    ]
    for name in sorted({*old["figures"]} & {*new["figures"]}):
        (a, error_a), (b, error_b) = old["figures"][name], new["figures"][name]
        least = ABSOLUTE if None in (error_a, error_b) else 0.0
        squares = (error_a or 0.0) ** 2 + (error_b or 0.0) ** 2
        error = max(squares**0.5, least, RELATIVE * abs(a))
        if not abs(a - b) <= DIFFERENT * error:
            found.append(f"{name}: {a:.4g} -> {b:.4g} (+- {error:.2g})")
    return found


def compared(old: Kept, new: Kept) -> Iterator[str]:
    """Yield a line a kind of cases, and then what differs, old beside new.

    Args:
        old: Results by the name of their case.
        new: The same of another tree.
    """
    kinds: dict[str, list[str]] = defaultdict(list)
    for name in old:
        if name in new:
            kinds[name.rpartition(" ")[0]].append(name)
    yield "| cases | compared | differ | CPU s, old and new | rows, old and new |"
    yield "| --- | --- | --- | --- | --- |"
    found = {name: differences(old[name], new[name]) for name in old if name in new}
    for kind, names in kinds.items():
        differ = sum(bool(found[name]) for name in names)
        cpu, rows = (
            [sum(side[name][what] for name in names) for side in (old, new)]
            for what in ("cpu_seconds", "rows")
        )
        yield (
            f"| {kind} | {len(names)} | {differ} | {cpu[0]:.0f}, {cpu[1]:.0f} "
            f"| {rows[0]:,}, {rows[1]:,} |"
        )
    yield ""
    for name, lines in found.items():
        for line in lines:
            yield f"{name}: {line}"
