"""``sbi-active bank``: simulate into a bank, and look into one."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.distributions import Distribution
from tqdm import tqdm

from sbi_active.actions import ActionSpace
from sbi_active.cli.given import problem_of
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.simulation.bank import Bank
from sbi_active.simulation.workers.store import RowStore, run_digest

#: Rows that are drawn and simulated at once. Part of the definition of a bank's theta
#: and action given a seed, so it is never a setting.
BLOCK = 8192


def build(
    folder: Path,
    *,
    simulator_version: str,
    rows: int,
    seed: int,
    workers: int,
    **problem: Any,
) -> None:
    """Simulate prior draws into a bank, from where it ended."""
    model, drawn, space, _ = problem_of(**problem)
    missing = 0
    with (
        Bank(
            folder,
            simulator=model,
            version=simulator_version,
            created=date.today().isoformat(),
        ) as bank,
        tqdm(total=rows, desc="bank", unit="row") as bar,
    ):
        store = bank.drawn_from(drawn, label="prior")
        for start in range(0, rows, BLOCK):
            block = derive_seed(seed, "bank", start)
            theta, action = _draw(drawn, space, block)
            num_rows = min(BLOCK, rows - start)
            done = simulate(
                model,
                theta[:num_rows],
                action[:num_rows],
                seed=block,
                workers=workers,
                store=_Block(store, run_digest(block, theta, action), num_rows),
            )
            missing += done.counts["missing"]
            bar.update(num_rows)
    print(f"{folder}: {len(bank)} rows, {bank.counts}")
    if missing:
        print(f"note: {missing} rows are missing; run again to try them once more")


@dataclass(frozen=True)
class _Block:
    """Stores the first rows of a block as rows of the whole, so that it can grow."""

    store: RowStore
    run: str
    num_rows: int

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        stored = self.store.load(self.run)
        if stored is None:
            return None
        mine = stored[0] < self.num_rows
        index, x, status = (column[mine] for column in stored)
        return (index, x, status) if len(index) else None

    def save(self, run: str, **rows: Any) -> None:
        self.store.save(self.run, **rows)


def _draw(
    prior: Distribution, actions: ActionSpace, seed: int
) -> tuple[Tensor, Tensor]:
    """Return theta and action of a whole block, whatever part of it is wanted."""
    with forked_generators(seed, "theta"):
        theta = prior.sample((BLOCK,))
    return theta.float(), actions.sample((BLOCK,), seed=derive_seed(seed, "action"))


def inspect(folder: Path) -> int:
    """Print what a bank holds; status 1 where checksums fail."""
    bank = Bank(folder)
    problems = bank.verify()
    if problems:
        print("\n".join(["checksums: NOT ok", *problems]))
        return 1
    header = bank.header
    simulator = f"{_shown(bank.simulator_name)} {_shown(header['version'])}"
    print(f"simulator: {simulator}".rstrip())
    print(f"created: {_shown(header['created'] or 'not noted')}")
    for name, shape in (header["shapes"] or {}).items():
        print(f"{name}: {' x '.join(map(str, shape))} a row")
    names = map(_shown, header["parameter_names"] or ["not named"])
    print(f"parameters: {', '.join(names)}")
    print(f"rows: {bank.counts}; on disk: {bank.num_bytes / 2**20:.2f} MiB")
    print("checksums: ok")
    if len(bank):
        labels = bank.labels
        counts = bank.columns("label")["label"].bincount(minlength=len(labels))
        for label, count in zip(labels, counts.tolist(), strict=True):
            print(f"drawn from {_shown(label) or 'an unknown proposal'}: {count}")
    return 0


def migrate(folder: Path) -> None:
    """Bring a folder of an earlier release up to date."""
    from sbi_active.migration import migrate

    found = migrate(folder)
    number = found.pop("log", None)
    if number is not None:
        print(f"log: {number} events")
    for name, num_rows in found.items():
        print(f"bank {name}: {num_rows} rows")
    print(f"the files of before are in {folder / 'version-1'}")


def _shown(text: str) -> str:
    """Return a text from a file so that it cannot steer the terminal."""
    return text if text.isprintable() else ascii(text)
