"""Stages that both machines with recorded inputs share, and their table.

- ``recorded``: the verdict on the pieces to fit, held-out errors in free run before and
  after, and plain least squares given the same effects on the same split.
- ``without NAME + ...``: the same with effects removed from the library.
- ``clean 2000``, ``clean 2001``, ...: the pieces simulated by the bare model at its
  least-squares fit, with the sensor's error alone, by their seeds.
- ``full 2000``, ...: the same with the effects that help in ``recorded``, at the
  least-squares fit with them: nothing but these is there to be named.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.criticism.scores import counted
from benchmarks.measured.record_least_squares import Fit
from benchmarks.measured.record_verdicts import read_report
from sbi_active import SimulatorModel
from sbi_active.criticism import Effect, Trials, close_loop

__all__ = [
    "Bench",
    "aliases",
    "judge",
    "Settings",
    "run_settings",
    "run_stages",
    "said",
    "table",
]

Errors = dict[str, float]

#: Seed of the first replay; nothing was chosen by those from here on.
FIRST_REPLAYED = 2_000
REPLAYS = {"clean": "the bare model", "full": "the model of the first verdict"}
#: What a report's first paragraph says of an effect that is named.
SHARE_LEFT = re.compile(r"\d+ %\s+of\s+the\s+excess")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A machine with records.

    Attributes:
        model: The bare simulator.
        prior: Of theta.
        effects: The declared library.
        trials: To fit.
        removals: Sets of effects to remove from the library, one stage each.
        given: Sets of effects that least squares is given in any case, each in the
            order of the library.
        score: Theta and strengths (n, d), and effects, to errors by held-out record.
        least_squares: Names of effects to a fit's row.
        replay: Seed and names of effects to trials that a fitted model makes.
        nuisances: Declared besides.
    """

    model: SimulatorModel
    prior: Any
    effects: Sequence[Effect]
    trials: Trials
    removals: Sequence[tuple[str, ...]]
    given: Sequence[tuple[str, ...]]
    score: Callable[[Tensor, Sequence[Effect]], Errors]
    least_squares: Callable[[tuple[str, ...]], dict[str, Any]]
    replay: Callable[[int, tuple[str, ...]], Trials]
    nuisances: Sequence[Effect] = ()

    @classmethod
    def of(cls, task: Any, **parts: Any) -> Bench:
        """Return the bench of a task.

        Args:
            task: A package with ``make_simulator``, ``make_prior`` and
                ``make_effects``.
            parts: All that the task does not say.
        """
        return cls(
            model=task.make_simulator(),
            prior=task.make_prior(),
            effects=task.make_effects(),
            **parts,
        )


@dataclass(frozen=True)
class Settings:
    """What is run of a task with records.

    Args:
        data: Folder of the measured set; the task's by default.
        every: Stride of the readings that are kept; the task's by default.
        clean: Number of clean sets.
        full: Number of sets with what helps.
        out: File of the results; the task's by default.
        reports: Folder for whole reports.
        seed: Seed of the engine.
    """

    data: Path | None = None
    every: int | None = None
    clean: int = 10
    full: int = 0
    out: Path | None = None
    reports: Path | None = None
    seed: int = 0


def run_settings(
    settings: Settings, task: Any, make_bench: Callable[..., Bench], out: Path
) -> int:
    """Run the stages that are missing from a file of results, and print the tables.

    Args:
        settings: What is run.
        task: A package with records.
        make_bench: ``make_bench(records, every=)``.
        out: The file, unless one is given.

    Returns:
        The process's exit status.
    """
    try:
        records = task.read_recordings(settings.data or task.DATA)
    except FileNotFoundError as error:
        print(f"{error}, as in --data DIR", file=sys.stderr)
        return 2
    rows = run_stages(
        make_bench(records, every=settings.every or task.recordings.EVERY),
        settings.out or out,
        clean=settings.clean,
        full=settings.full,
        seed=settings.seed,
        reports=settings.reports,
    )
    print(table(rows, "V"))
    return 0


def run_stages(
    bench: Bench,
    path: Path,
    *,
    clean: int = 10,
    full: int = 0,
    seed: int = 0,
    reports: Path | None = None,
) -> dict[str, Any]:
    """Run the stages that a file lacks, and return all of them.

    Args:
        bench: The machine.
        path: JSON file of the results.
        clean: Clean sets.
        full: Sets that the model of the first verdict makes.
        seed: Of all draws.
        reports: Folder for whole reports.
    """
    rows: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}

    def keep(name: str, row: dict[str, Any]) -> None:
        rows[name] = row
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1) + "\n")
        if "line" in row:
            text = f"{name}: {row['line']}, {row['cpu_seconds']:.0f} CPU s"
            print(text, flush=True)

    judged: dict[str, tuple[str, ...]] = {"recorded": ()}
    judged |= {f"without {' + '.join(gone)}": gone for gone in bench.removals}
    stages = [*judged]
    stages += [f"clean {FIRST_REPLAYED + k}" for k in range(clean)]
    stages += [f"full {FIRST_REPLAYED + k}" for k in range(full)]
    for name in stages:
        if name not in rows:
            kind, number = name.split(" ")[0], name.split(" ")[-1]
            trials = None
            if name not in judged:
                helps = (*rows["recorded"]["helps"],) if kind == "full" else ()
                trials = bench.replay(int(number), helps)
            folder = None if reports is None else reports / name.replace(" ", "_")
            gone = judged.get(name, ())
            keep(name, judge(bench, gone=gone, trials=trials, seed=seed, folder=folder))
    fits = rows.get("least squares", {})
    wanted = {(), *bench.given, *[(*rows[name]["helps"],) for name in judged]}
    for names in sorted(wanted):
        label = " + ".join(names) or "none"
        if label not in fits:
            fits[label] = bench.least_squares(names)
            keep("least squares", fits)
    return rows


def judge(
    bench: Bench,
    *,
    gone: Sequence[str] = (),
    trials: Trials | None = None,
    seed: int = 0,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Return the row of one verdict.

    Args:
        bench: The machine.
        gone: Names of effects that are not declared.
        trials: In place of the recorded ones.
        seed: Of all draws.
        folder: Where the whole report goes.
    """
    effects = [effect for effect in bench.effects if effect.name not in gone]
    model, count = counted(bench.model)
    begin = time.process_time()
    report = close_loop(
        model,
        bench.prior,
        bench.trials if trials is None else trials,
        effects=[*effects, *bench.nuisances],
        seed=seed,
        evaluate=False,  # held-out records are scored in free run, below
        plan=False,
    )
    seconds = time.process_time() - begin
    if folder is not None:
        report.save(folder)
    found = read_report(report, bench.prior.event_shape[0])
    row = {
        **found.row,
        "helps": [*found.helps],
        "text": found.text,
        "cpu_seconds": seconds,
        "trial_simulations": count(),
    }
    if trials is None:
        chosen = [e for n in found.helps for e in effects if e.name == n]
        row["before"] = bench.score(found.before, [])
        row["after"] = bench.score(found.after, chosen)
    return row


def as_row(fit: Fit, errors: Errors) -> dict[str, Any]:
    """Return a least-squares fit as plain figures."""
    return {"parameters": fit.parameters.tolist(), "fitted": fit.rmse, "held": errors}


def table(rows: dict[str, Any], unit: str) -> str:
    """Return the stages and the least-squares fits in Markdown.

    Args:
        rows: Of :func:`run_stages`.
        unit: Of the errors.
    """
    records = [*rows["recorded"]["before"]]
    head = " / ".join(records)
    lines = [
        f"| stage | verdict | P(cause) | before, {unit}: {head} | after | simulated "
        "trials | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        if name == "least squares" or name.split(" ")[0] in REPLAYS:
            continue
        likely = {n: p for n, p in row["cause"].items() if p > 0.05 and row["alarm"]}
        causes = ", ".join(f"{n} {p:.2f}" for n, p in likely.items())
        lines.append(
            f"| {name} | {said(row)} | {causes} | {_errors(row.get('before'))} | "
            f"{_errors(row.get('after'))} | {row['trial_simulations']:,} | "
            f"{row['cpu_seconds']:.0f} |"
        )
    lines += _replays(rows)
    if any(name.startswith("without ") for name in rows):
        lines += ["", aliases(rows)]
    lines += ["", f"| least squares | fitted, {unit} | {head} |", "|---|---|---|"]
    for name, row in rows.get("least squares", {}).items():
        lines.append(f"| {name} | {row['fitted']:.3f} | {_errors(row['held'])} |")
    return "\n".join(lines)


def said(row: dict[str, Any]) -> str:
    """Return the verdict of a stage, and what else helps to predict."""
    beside = [name for name in row["helps"] if name not in row["named"]]
    helps = f", {' + '.join(beside)} helps" if beside else ""
    return f"{row['verdict']}{helps}"


def _replays(rows: dict[str, Any]) -> list[str]:
    """Return a line for each kind of replay: its verdicts, and how often."""
    lines = []
    for kind, what in REPLAYS.items():
        own = {k: row for k, row in rows.items() if k.split(" ")[0] == kind}
        if not own:
            continue
        verdicts = Counter(str(row["verdict"]) for row in own.values())
        said = ", ".join(f"{v} ({n})" for v, n in verdicts.most_common())
        seeds = sorted(int(k.split(" ")[-1]) for k in own)
        count, seconds = (
            np.median([row[key] for row in own.values()])
            for key in ("trial_simulations", "cpu_seconds")
        )
        lines.append(
            f"| {len(own)} replays of {what}, seeds {seeds[0]} to {seeds[-1]} | {said} "
            f"| | | | {count:,.0f} | {seconds:.0f} |"
        )
    return lines


def aliases(rows: dict[str, Any]) -> str:
    """Return how often an effect was named that stands for one that was removed.

    One counts that the verdict with the whole library does not rest on.

    Args:
        rows: Of :func:`run_stages`.
    """
    removed = {k: row for k, row in rows.items() if k.startswith("without ")}
    real = {*rows["recorded"]["helps"]}
    found, told = [], 0
    for name, row in removed.items():
        if new := [n for n in row["named"] if n not in real]:
            found.append(f"{' + '.join(new)} ({name})")
            told += bool(SHARE_LEFT.search(row["text"]))
    said = f": {'; '.join(found)}; the share left said in {told}" if found else ""
    return f"Aliases named: {len(found)} of {len(removed)} removals{said}."


def _errors(errors: Errors | None) -> str:
    return "" if errors is None else " / ".join(f"{e:.3f}" for e in errors.values())


def with_error(x: Tensor, sd: float, seed: int) -> np.ndarray:
    """Return readings with a sensor's error.

    Args:
        x: Without it.
        sd: Of the error.
        seed: Of its draw.
    """
    generator = torch.Generator().manual_seed(seed)
    return (x + sd * torch.randn(x.shape, generator=generator, dtype=x.dtype)).numpy()
