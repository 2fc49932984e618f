"""Stages that both machines with recorded inputs share, and their table.

- ``recorded``: the verdict on the pieces to fit, held-out errors in free run before and
  after, and plain least squares given the same effects on the same split.
- ``without NAME + ...``: the same with effects removed from the library.
- ``clean 2000``, ``clean 2001``, ...: the pieces simulated by the bare model at its
  least-squares fit, with the sensor's error alone, by their seeds.

What the loop says of recorded trials: the one place that knows a report's layout.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.criticism.problem import Problem
from benchmarks.rows import add, keep, measured, stages
from benchmarks.table import shown
from sbi_active import SimulatorModel
from sbi_active.criticism import Effect, Report, Trials
from sbi_active.criticism.results import NONE, Evidence, Tracing

#: What a report's first paragraph says of an effect that is named.
SHARE_LEFT = re.compile(r"\d+ %\s+of\s+the\s+excess")


def row_of(tracing: Tracing) -> dict[str, Any]:
    """Return a verdict as plain figures."""
    misfit, helps = tracing.misfit, tracing.chosen
    support = {} if misfit is None else misfit.support
    model = tracing.evidences.get(" + ".join(helps) or NONE, tracing.evidences[NONE])
    return {
        "verdict": tracing.verdict,
        "named": [*(helps if misfit is None else misfit.named)],
        "helps": [*helps],
        "open_forms": {} if misfit is None else misfit.open_forms,
        "support": {
            name: [own.inclusion, own.gained, own.remains]
            for name, own in support.items()
        },
        "probabilities": {n: float(p) for n, p in tracing.probabilities.items()},
        "credible_set": [*tracing.credible_set],
        "parameters": spreads(model),
    }


def read_report(report: Report) -> dict[str, Any]:
    """Return what a report says as plain figures."""
    return row_of(report.tracing) | {
        "line": str(report).splitlines()[0],
        "text": str(report).split("\n\n")[0],
        "alarm": bool(report.detection.alarm),
        "log_bayes_factor": float(report.detection.log_bayes_factor),
    }


def reported(
    model: SimulatorModel, prior: Any, trials: Trials, effects: Sequence[Effect]
) -> tuple[Report, dict[str, Any]]:
    """Return the report on the trials to fit, and its row.

    Args:
        model: The bare simulator.
        prior: Prior of theta.
        trials: Trials to fit; what is held out is scored elsewhere.
        effects: The declared library.
    """
    problem = Problem(model=model, prior=prior, trials=trials, effects=[*effects])
    report, cost = problem.counted_report(0, evaluate=False, plan=False)
    return report, read_report(report) | cost


def spreads(evidence: Evidence) -> dict[str, list[float]]:
    """Return mean and standard deviation of each parameter of a model."""
    pairs = zip(evidence.names, evidence.draws.T, strict=True)
    return {name: [float(z.mean()), float(z.std())] for name, z in pairs}


def center(evidence: Evidence, columns: int | None = None) -> Tensor:
    """Return the best fit where every model misses, as the library predicts by it.

    Draws as wide as misfit asks leave the valley that the best fit lies in.

    Args:
        evidence: Evidence of the model.
        columns: Number of its parameters and strengths; None for all, (1, columns).
    """
    best = evidence.draws.mean(0) if evidence.best is None else evidence.best
    return torch.from_numpy(best[None, :columns]).double()


def said(row: Mapping[str, Any]) -> str:
    """Return the verdict of a row, and what else helps to predict."""
    beside = [name for name in row["helps"] if name not in row["named"]]
    forms = [f"{n}: {family}" for n, family in row.get("open_forms", {}).items()]
    told = row["verdict"] + (f" (form open, {', '.join(forms)})" if forms else "")
    return told + (f", {' + '.join(beside)} helps" if beside else "")


def causes(row: Mapping[str, Any]) -> str:
    """Return the share of the excess that each effect that helps leaves."""
    support = row.get("support", {})
    return ", ".join(f"{n} {100 * left:.0f} %" for n, (*_, left) in support.items())


def shares_left(row: Mapping[str, Any]) -> bool:
    """Return whether a row's text says which share of the excess is left."""
    return SHARE_LEFT.search(row["text"]) is not None


Errors = dict[str, float]
#: Seed of the first replay; nothing was chosen by those from here on.
FIRST_REPLAYED = 2_000


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A machine with records.

    Attributes:
        model: The bare simulator.
        prior: Prior of theta.
        effects: The declared library.
        trials: Trials to fit.
        removals: Sets of effects to remove from the library, one stage each.
        score: Function of theta and strengths (n, d), and effects, to errors by
            held-out record.
        least_squares: Function of names of effects to a fit's row.
        replay: Function of a seed to trials that the fitted bare model makes.
    """

    model: SimulatorModel
    prior: Any
    effects: Sequence[Effect]
    trials: Trials
    removals: Sequence[tuple[str, ...]]
    score: Callable[[Tensor, Sequence[Effect]], Errors]
    least_squares: Callable[[tuple[str, ...]], dict[str, Any]]
    replay: Callable[[int], Trials]

    @classmethod
    def of(cls, task: Any, **parts: Any) -> Bench:
        """Return the bench of a task.

        Args:
            task: Package with ``make_simulator``, ``make_prior`` and ``make_effects``.
            parts: All that the task does not say.
        """
        made = task.make_simulator(), task.make_prior(), task.make_effects()
        return cls(
            **dict(zip(("model", "prior", "effects"), made, strict=True)), **parts
        )


def stages_of(
    task: Any, make_bench: Callable[..., Bench], path: Path
) -> Callable[..., None]:
    """Return the main of a benchmark of records.

    Args:
        task: Package with records.
        make_bench: Function ``make_bench(records)``.
        path: File of the results.
    """

    def main(*, data: Path = task.DATA) -> None:
        """Run the stages that are missing from the results, and print the tables.

        Args:
            data: Folder of the measured set.
        """
        records = measured(task.read_recordings, data)
        run_stages(make_bench(records), path)
        figures = ("verdict", "named", "helps", "support", "before", "after", "fitted")
        print(shown(path, *(f"*, {name}*" for name in figures), "*held*", "*cpu*"))

    return main


def run_stages(bench: Bench, path: Path, clean: int = 10) -> dict[str, Any]:
    """Run the stages that a file lacks, and return all of them.

    Args:
        bench: The machine.
        path: JSON file of the results.
        clean: Number of clean sets.
    """
    rows = stages(path)
    judged: dict[str, tuple[str, ...]] = {"recorded": ()}
    judged |= {f"without {' + '.join(gone)}": gone for gone in bench.removals}
    names = [*judged]
    names += [f"clean {FIRST_REPLAYED + k}" for k in range(clean)]
    for name in [name for name in names if name not in rows]:
        is_clean = name not in judged
        trials = bench.replay(int(name.split(" ")[1])) if is_clean else None
        row = judge(bench, gone=judged.get(name, ()), trials=trials)
        add(path, rows, name, row)
    fits = rows.setdefault("least squares", {})
    wanted = {(), *[(*rows[name]["helps"],) for name in judged]}
    for given in sorted(wanted):
        label = " + ".join(given) or "none"
        if label not in fits:
            fits[label] = bench.least_squares(given)
            keep(path, rows)
    return rows


def judge(
    bench: Bench,
    *,
    gone: Sequence[str] = (),
    trials: Trials | None = None,
) -> dict[str, Any]:
    """Return the row of one verdict.

    Args:
        bench: The machine.
        gone: Names of effects that are not declared.
        trials: Trials in place of the recorded ones.
    """
    effects = [effect for effect in bench.effects if effect.name not in gone]
    given = bench.trials if trials is None else trials
    report, row = reported(bench.model, bench.prior, given, effects)
    if trials is None:
        helps, evidences = report.tracing.chosen, report.tracing.evidences
        chosen = [e for name in helps for e in effects if e.name == name]
        best = evidences.get(" + ".join(helps) or NONE, evidences[NONE])
        # Columns beyond these are those of nuisances.
        dim = bench.prior.event_shape[0]
        num = dim + sum(effect.phi_dim for effect in chosen)
        row["before"] = bench.score(center(evidences[NONE], dim), [])
        row["after"] = bench.score(center(best, num), chosen)
    return row


def with_error(x: Tensor, sd: float, seed: int) -> np.ndarray:
    """Return readings with a sensor's error of a standard deviation."""
    generator = torch.Generator().manual_seed(seed)
    return (x + sd * torch.randn(x.shape, generator=generator, dtype=x.dtype)).numpy()
