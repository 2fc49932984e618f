"""The closed loop where every model is wrong, on worlds whose truth is known.

    python -m benchmarks misfit --group own --kind E --cases 2580 2612
    python -m benchmarks misfit --group letters --kind E --cases 2680 2718
    python -m benchmarks misfit --summary

Machines have a declared sensor, wide priors, about nine declared effects, and a smooth
discrepancy of 2 to 10 sensor deviations that nobody declared. Kinds: E, an effect
beside it; R, the same with the effect removed from the library; M, the discrepancy
alone; P, a fast and a slow effect beside it; C, clean; CE, an effect alone. Groups: own
(pendulum, driven spring, tanks; 10 trials of 20 samples and 6 of 30 by turns) and
letters (worlds A, B, C of the benchmark of criticism with a discrepancy).

Seeds are the numbers of cases. **Those below 1,000 are for tuning; those from 1,000 on
judge**: they have other undeclared forms, and rough processes besides, and nothing may
be tuned on them.

Resumable: a case that stands in the CSV is not run again. One row a case, one file a
group and kind, in benchmarks/misfit/results. Give each command a core of its own
(OMP_NUM_THREADS=1).

Scores of one case, from the public report and the truth alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.criticism.problem import named
from benchmarks.misfit.cases import FIRST_JUDGED, KINDS, Kind, draw_case
from benchmarks.misfit.machines import GROUPS
from benchmarks.misfit.summary import summary
from benchmarks.misfit.truth import Truth
from benchmarks.rows import benchmark, grouped
from sbi_active.criticism import Effect
from sbi_active.criticism.results import NONE, Tracing

LEVEL = 0.9  # of intervals


def row_of(group: str, kind: Kind, number: int) -> dict[str, object]:
    """Run the loop on a case and return its row of the results.

    Held-out trials have no part in the verdict. Their errors are those of plain
    least-squares fits of the bare model, of the true effects and of the effects that
    the verdict says help, against readings without the sensor's error.

    Args:
        group: Of worlds.
        kind: Kind of the case.
        number: Its number, also the loop's seed.
    """
    case = draw_case(group, kind, number)
    truth = case.truth
    # The truth has the held-out trials.
    report, cost = case.problem.counted_report(number, evaluate=False, plan=False)
    tracing, misfit = report.tracing, report.tracing.misfit
    instead = {} if misfit is None else misfit.instead
    found = [truth.machine.effect(name) for name in tracing.chosen]
    return {
        **_known(truth),
        "held_verdict": truth.held_out_error(found),
        "verdict": str(report).splitlines()[0],
        "alarm": bool(report.detection.alarm),
        "named": json.dumps([*named(report)]),
        "helps": json.dumps([*tracing.chosen]),
        "instead": json.dumps({k: [*names] for k, names in instead.items()}),
        **_covered(truth, tracing),
        **cost,
    }


def _known(truth: Truth) -> dict[str, object]:
    """Return what is known without the loop."""
    what, machine = truth.discrepancy, truth.machine
    bare = truth.held_out_error(())
    return {
        "machine": machine.name,
        "trials": machine.num_trials,
        "kind": truth.kind,
        "true": json.dumps([*truth.names]),
        "equivalent": json.dumps(
            sorted(frozenset().union(*[machine.equivalent(n) for n in truth.names]))
        ),
        "discrepancy": "" if what is None else what.kind,
        "held_bare": bare,
        "held_true": truth.held_out_error(truth.effects) if truth.effects else bare,
        "held_single": _singles(truth, truth.effects),
    }


def _singles(truth: Truth, effects: Sequence[Effect]) -> float | str:
    """Return the error of the better one of two effects."""
    if len(effects) < 2:
        return ""
    return min(truth.held_out_error([effect]) for effect in effects)


def _covered(truth: Truth, tracing: Tracing) -> dict[str, object]:
    """Return how many true numbers lie within their 90 % intervals, "k/n"."""
    library = [effect.name for effect in truth.machine.library]
    true = sorted(truth.names, key=library.index)
    evidence = tracing.evidences.get(" + ".join(true) or NONE)
    if evidence is None:
        return {}
    ends = np.quantile(evidence.draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    intervals = dict(zip(evidence.names, ends.T, strict=True))
    values = zip(truth.machine.parameter_names, truth.theta[0].tolist(), strict=True)
    phi = [
        pair
        for effect, strength in zip(truth.effects, truth.strengths, strict=True)
        for pair in zip(effect.phi_names, strength[0].tolist(), strict=True)
    ]

    def share(known: Sequence[tuple[str, float]]) -> str:
        hits = [intervals[n][0] <= v <= intervals[n][1] for n, v in known]
        return f"{sum(hits)}/{len(hits)}"

    covered: dict[str, object] = {"theta_covered": share([*values])}
    return covered | ({"phi_covered": share(phi)} if phi else {})


def table(rows: list[dict[str, str]]) -> str:
    """Return the measures of each group, and of all together."""
    parts = {group: own for (group,), own in grouped(rows, "group").items()}
    if len(parts) > 1:
        parts[" and ".join(parts)] = rows
    lines: list[str] = []
    for name, own in parts.items():
        is_judged = all(int(row["case"]) >= FIRST_JUDGED for row in own)
        seeds = "judging" if is_judged else "tuning"
        lines += ["", f"## {name}, {seeds} seeds", *summary(own)]
    return "\n".join(lines)


main = benchmark(
    Path(__file__).parent / "results" / "{group}_{kind}.csv",
    row_of,
    table,
    may_fail=True,
    group=GROUPS,
    kind=KINDS,
    case=range(2_580, 2_740),
)
