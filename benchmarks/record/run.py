"""Results of today's cases, and what a later tree changes of them.

Resumable: results go to a file of lines as they come, which goes when all that was
asked for is there; remove it where the tree changed in between. ``--against`` runs the
cases anew and prints old and new side by side, with what differs by more than its Monte
Carlo error. Every fifth case is run with another seed of the engine as well:
``--summary`` says how often that alone makes a difference.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import asdict
from pathlib import Path

from benchmarks.record.cases import cases, run
from benchmarks.record.comparison import Kept, compared

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
