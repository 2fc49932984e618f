"""``sbi-active bank``: simulate into a bank, and look into one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from tqdm import tqdm

from sbi_active.actions import ActionSpace
from sbi_active.cli.loading import load_object, make_task
from sbi_active.plots import as_table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import Outcome, simulate
from sbi_active.simulation.bank import Bank
from sbi_active.simulation.bank.labeled import LabeledStore
from sbi_active.simulation.workers.store import run_digest

#: Rows that are drawn and simulated at once. Part of the definition of a bank's theta
#: and action given a seed, so it is never a setting.
BLOCK = 8192

#: Lines of the table of outcomes.
LINES = 30


def build(arguments: argparse.Namespace) -> int:
    """Simulate prior draws into a bank, from where it ended."""
    simulator, prior, actions = _source(arguments)
    missing = 0
    with (
        Bank(
            arguments.folder,
            simulator=simulator,
            version=arguments.simulator_version,
            created=date.today().isoformat(),
        ) as bank,
        tqdm(total=arguments.rows, desc="bank", unit="row") as bar,
    ):
        store = bank.drawn_from(prior, label="prior")
        for start in range(0, arguments.rows, BLOCK):
            seed = derive_seed(arguments.seed, "bank", start)
            theta, action = _draw(prior, actions, seed)
            num_rows = min(BLOCK, arguments.rows - start)
            rows = simulate(
                simulator,
                theta[:num_rows],
                action[:num_rows],
                seed=seed,
                num_workers=arguments.workers,
                store=_Block(store, run_digest(seed, theta, action), num_rows),
            )
            missing += rows.counts["missing"]
            bar.update(num_rows)
    print(f"{arguments.folder}: {len(bank)} rows, {bank.counts}")
    if missing:
        print(f"note: {missing} rows are missing; run again to try them once more")
    return 0


@dataclass(frozen=True)
class _Block:
    """Stores the first rows of a block as rows of the whole, so that it can grow."""

    store: LabeledStore
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


def _source(
    arguments: argparse.Namespace,
) -> tuple[Callable[..., Any], Distribution, ActionSpace]:
    if arguments.task is not None:
        task = make_task(arguments.task, arguments.option)
        return task.simulator, task.prior, task.actions
    if arguments.prior is None or arguments.actions is None:
        raise ValueError(
            "expected --prior and --actions with --simulator; got one without the "
            "other; name them, as in --prior my_robot:prior"
        )
    return (
        load_object(arguments.simulator),
        load_object(arguments.prior),
        load_object(arguments.actions),
    )


def inspect(arguments: argparse.Namespace) -> int:
    """Print what a bank holds; status 1 where checksums fail."""
    bank = Bank(arguments.folder)
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
    print(f"rows: {len(bank)}; on disk: {bank.num_bytes / 2**20:.2f} MiB")
    print("checksums: ok")
    if len(bank):
        column = bank.columns("action", "status", "label")
        for code, label in enumerate(bank.labels):
            count = int((column["label"] == code).sum())
            print(f"drawn from {_shown(label) or 'an unknown proposal'}: {count}")
        print(_outcomes(column["action"], column["status"]))
    return 0


def migrate(arguments: argparse.Namespace) -> int:
    """Bring a folder of an earlier release up to date."""
    from sbi_active.migration import migrate

    found = migrate(arguments.folder)
    number = found.pop("log", None)
    if number is not None:
        print(f"log: {number} events")
    for name, num_rows in found.items():
        print(f"bank {name}: {num_rows} rows")
    print(f"the files of before are in {arguments.folder / 'version-1'}")
    return 0


def _shown(text: str) -> str:
    """Return a text from a file so that it cannot steer the terminal."""
    return text if text.isprintable() else ascii(text)


def _outcomes(action: Tensor, status: Tensor) -> str:
    """Return a table of outcomes by action, or by part of each action's range."""
    distinct, inverse = torch.unique(action, dim=0, return_inverse=True)
    names = ["action", *(o.name.lower() for o in Outcome)]
    if len(distinct) <= LINES:
        cells = [", ".join(f"{a:g}" for a in row) for row in distinct.tolist()]
        return as_table(_counts(cells, inverse, status), names)
    tables = []
    for d in range(action.shape[1]):
        edges = torch.linspace(float(action[:, d].min()), float(action[:, d].max()), 11)
        part = torch.bucketize(action[:, d].contiguous(), edges[1:-1])
        cells = [f"{a:g} to {b:g}" for a, b in zip(edges[:-1], edges[1:], strict=True)]
        heading = [f"action {d + 1}", *names[1:]]
        tables.append(as_table(_counts(cells, part, status), heading))
    return "\n".join(tables)


def _counts(cells: list[str], group: Tensor, status: Tensor) -> list[list[str]]:
    table = torch.stack(
        [torch.bincount(group[status == o], minlength=len(cells)) for o in Outcome], 1
    )
    return [[c, *map(str, n)] for c, n in zip(cells, table.tolist(), strict=True)]
