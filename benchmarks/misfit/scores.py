"""Scores of one case, from the public report and the truth alone."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace

from benchmarks.criticism.scores import counted
from benchmarks.misfit.cases import Case
from benchmarks.misfit.truth import Truth
from benchmarks.misfit.verdicts import Outcome, read_report
from sbi_active.criticism import Effect

COLUMNS = [
    *["case", "machine", "trials", "kind", "true", "equivalent", "sizes", "strengths"],
    *["discrepancy", "detail", "size", "excess", "theta"],
    *["held_bare", "held_true", "held_single", "held_verdict"],
    *["verdict", "alarm", "named", "helps", "instead", "support"],
    *["theta_covered", "phi_covered", "trial_simulations", "cpu_seconds", "failure"],
]


def score_case(case: Case, number: int) -> dict[str, object]:
    """Run the loop on a case and return its row of the results.

    Held-out trials have no part in the verdict. Their errors are those of plain
    least-squares fits of the bare model, of the true effects and of the effects that
    the verdict says help, against readings without the sensor's error.

    Args:
        case: The case.
        number: Its number, also the loop's seed.
    """
    problem, truth = case.problem, case.truth
    row = dict.fromkeys(COLUMNS, "") | _known(truth) | {"case": number}
    model, count = counted(problem.model)
    start = time.process_time()
    try:
        # The truth has the held-out trials.
        counting = replace(problem, model=model)
        report = counting.report(number, evaluate=False, plan=False)
    except Exception as error:  # a crash is a result of the benchmark
        return row | {"failure": f"{type(error).__name__}: {error}"[:300]}
    seconds = time.process_time() - start
    library = [effect.name for effect in truth.machine.library]
    true = sorted(truth.names, key=library.index)
    outcome = read_report(report, true)
    found = [truth.machine.effect(name) for name in outcome.helps]
    return row | {
        "held_verdict": truth.held_out_error(found),
        "verdict": outcome.line,
        "alarm": outcome.alarm,
        "named": json.dumps([*outcome.named]),
        "helps": json.dumps([*outcome.helps]),
        "instead": json.dumps({k: [*names] for k, names in outcome.instead.items()}),
        "support": json.dumps(
            {k: [round(v, 4) for v in own] for k, own in outcome.support.items()}
        ),
        **_covered(truth, outcome),
        "trial_simulations": count(),
        "cpu_seconds": seconds,
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
        "sizes": " ".join(f"{size:.3g}" for size in truth.sizes),
        "strengths": " ".join(
            f"{value:.5g}" for phi in truth.strengths for value in phi[0].tolist()
        ),
        "discrepancy": "" if what is None else what.kind,
        "detail": "" if what is None else what.detail,
        "size": truth.size,
        "excess": truth.excess(),
        "theta": " ".join(f"{value:.5g}" for value in truth.theta[0].tolist()),
        "held_bare": bare,
        "held_true": truth.held_out_error(truth.effects) if truth.effects else bare,
        "held_single": _singles(truth, truth.effects),
    }


def _singles(truth: Truth, effects: Sequence[Effect]) -> float | str:
    """Return the error of the better one of two effects."""
    if len(effects) < 2:
        return ""
    return min(truth.held_out_error([effect]) for effect in effects)


def _covered(truth: Truth, outcome: Outcome) -> dict[str, object]:
    """Return how many true numbers lie within their intervals, "k/n"."""
    if not outcome.intervals:
        return {}
    values = dict(
        zip(truth.machine.parameter_names, truth.theta[0].tolist(), strict=True)
    )
    phi = {
        name: value
        for effect, strength in zip(truth.effects, truth.strengths, strict=True)
        for name, value in zip(effect.phi_names, strength[0].tolist(), strict=True)
    }

    def share(known: dict[str, float]) -> str:
        ends = [outcome.intervals[name] for name in known]
        hit = sum(
            low <= value <= high
            for value, (low, high) in zip(known.values(), ends, strict=True)
        )
        return f"{hit}/{len(known)}"

    covered: dict[str, object] = {"theta_covered": share(values)}
    return covered | ({"phi_covered": share(phi)} if phi else {})
