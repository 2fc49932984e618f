"""Trials chosen by the loop beside random ones.

Two trials tell nothing about which model is right, and less cannot be compared. The
random policy makes them at random; the choosing one designs them before any data, for
the joint information about the parameters under the prior, and goes on for the model
index. All trials count, and both policies have the same noise in the trial of a number.
Only cases are run whose effect a table of its own would
expect to be named: lambda above 25 with all of the *random* policy's trials. That
leaves out effects too weak to be seen, effects equivalent to none, and noise inflation
(lambda 0). It is fixed before any verdict, is the same for both policies, and where it
favors one it is the random policy, whose trials are known to show the effect.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from benchmarks.criticism.cases import Case, extend
from benchmarks.criticism.equivalence import merged, true_name
from benchmarks.criticism.scores import counted
from benchmarks.criticism.worlds import get_world
from sbi_active import InformationGainDesigner
from sbi_active.criticism import Criticism

ACTIVE_COLUMNS = [
    *["case", "effects", "policy", "trials", "action", "verdict", "top", "place"],
    *["probability", "lambda", "trial_simulations", "cpu_seconds", "failure"],
]
START = 2  # trials before the first comparison
DETECTABLE = 25.0  # lambda with all random trials


def score_active(case: Case, number: int) -> list[dict[str, object]]:
    """Return one row a policy and number of trials, up to those of the case.

    Columns of the scores, with equivalent effects counted as one: "top", whether the
    truth is the most probable of all, "none" included; "place", its place among the
    effects alone; "probability", its own.

    Args:
        case: The case, whose actions are the random policy's.
        number: Its number, also the loop's seed.

    Returns:
        The rows; of a case that is left out, one row without a verdict.
    """
    every = case.truth.action
    rows: list[dict[str, object]] = []
    if case.truth.non_centrality <= DETECTABLE:
        return [_row(case, number, "random")]
    starts = {"random": every[:START], "chosen": first_actions(case.truth.world.name)}
    for policy, action in starts.items():
        grown = Case(case.problem, replace(case.truth, action=action[:-1]))
        grown = extend(grown, action[-1])
        for num in range(START, len(every) + 1):
            rows.append(_row(grown, number, policy))
            start = time.process_time()
            following = None
            try:
                criticism, scores = _verdict(grown, number)
                if policy == "chosen" and num < len(every):
                    following = criticism.next_action(beyond=False).action
            except Exception as error:  # a crash is a result of the benchmark
                rows[-1]["failure"] = f"{type(error).__name__}: {error}"[:300]
                break
            rows[-1] |= {"cpu_seconds": time.process_time() - start, **scores}
            if num < len(every):
                random = every[num]
                action = random if following is None else torch.as_tensor(following)
                grown = extend(grown, action.float())
    return rows


@cache
def first_actions(world: str) -> Tensor:
    """Return the first trials that are chosen, without data, shape (START, d)."""
    known = get_world(world)
    designer = InformationGainDesigner(known.actions)
    design = designer.select(
        None, known.model, belief=known.prior, num_actions=START, seed=0
    )
    return design.action


def _row(case: Case, number: int, policy: str) -> dict[str, object]:
    action = case.truth.action
    blank: dict[str, object] = dict.fromkeys(ACTIVE_COLUMNS, "")
    return blank | {
        "case": number,
        "effects": " + ".join(case.truth.names),
        "policy": policy,
        "trials": len(action),
        "action": " ".join(f"{v:g}" for v in action[-1].tolist()),
        "lambda": case.truth.non_centrality,
    }


def _verdict(case: Case, number: int) -> tuple[Criticism, dict[str, object]]:
    problem, world = case.problem, case.truth.world
    model, count = counted(problem.model)
    criticism = replace(problem, model=model).criticism(number)
    tracing = criticism.trace()
    stated = merged(world, tracing.probabilities)
    truth = next(iter(merged(world, {true_name(world, *case.truth.names): 1.0})))
    order = [name for name in stated if name != "none"]
    return criticism, {
        "trial_simulations": count(),
        "verdict": tracing.verdict,
        "top": next(iter(stated)) == truth,
        "place": order.index(truth) + 1 if truth in order else len(order) + 1,
        "probability": stated.get(truth, 0.0),
    }
