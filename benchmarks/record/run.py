"""Results of today's cases, and what a later tree changes of them.

Resumable: results go to a file of lines as they come, which goes when all that was
asked for is there; remove it where the tree changed in between. ``--against`` runs the
cases anew and prints old and new side by side, with what differs by more than its Monte
Carlo error. Every fifth case is run with another seed of the engine as well:
``--summary`` says how often that alone makes a difference.

Old and new results side by side.
"""

from __future__ import annotations

import gzip
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.record.cases import cases, run

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


FILE = Path(__file__).with_name("record.jsonl.gz")
#: Lines of a run that goes on; not committed.
WORK = FILE.with_name("running.jsonl")
TWICE = 5


def read(path: Path) -> Kept:
    """Return results by the name of their case; none where there is no file."""
    if not path.exists():
        return {}
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8") as file:
        return {row.pop("case"): row for row in map(json.loads, file)}


def write(results: Kept, path: Path) -> None:
    """Write results compressed, the same bytes for the same results."""
    lines = [json.dumps({"case": name, **row}) for name, row in results.items()]
    text = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(text, mtime=0))


def main(
    *,
    summary: bool = False,
    against: bool = False,
    only: str = "",
    work: Path = WORK,
) -> None:
    """Record the cases, or compare with the record.

    Args:
        summary: Whether to run nothing.
        against: Whether to compare with the record, and not to write it.
        only: What the names of cases begin with.
        work: File of the lines of a run that goes on.
    """
    if not summary:
        done = read(work)
        for number, (name, case) in enumerate(cases().items()):
            twice = number % TWICE == 0 and not against
            for seed in (0, 1) if twice else (0,):
                label = name if seed == 0 else f"again {name}"
                if label in done or not name.startswith(only):
                    continue
                row = {"case": label, **asdict(run(case, seed))}
                with work.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    old, new = read(FILE), {} if summary else read(work)
    if not (summary or against):
        old |= new
        write(old, FILE)
    if not against:
        new = {
            name.removeprefix("again "): row
            for name, row in old.items()
            if name.startswith("again ")
        }
        print(f"{len(old) - len(new)} cases; those with another seed of the engine:")
    print("\n".join(compared(old, new)))
    if not summary:
        work.unlink(missing_ok=True)
