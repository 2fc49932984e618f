"""Trials chosen by the loop beside random ones."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from benchmarks.criticism.cases import Case, extend
from benchmarks.criticism.equivalence import merged, true_name
from benchmarks.criticism.scores import counted
from sbi_active.criticism import Criticism

__all__ = ["ACTIVE_COLUMNS", "score_active"]

ACTIVE_COLUMNS = [
    *["case", "effects", "policy", "trials", "action", "verdict", "top", "probability"],
    *["lambda", "trial_simulations", "cpu_seconds", "failure"],
]
START = 3  # trials at random that both policies share


def score_active(case: Case, number: int) -> list[dict[str, object]]:
    """Return one row a policy and number of trials, up to those of the case.

    Args:
        case: The case, whose actions are the random policy's.
        number: Its number, also the loop's seed.
    """
    rows: list[dict[str, object]] = []
    every = case.truth.action
    for policy in ("random", "chosen"):
        grown = Case(case.problem, replace(case.truth, action=every[: START - 1]))
        following = every[START - 1]
        for num in range(START, len(every) + 1):
            grown = extend(grown, following)
            row: dict[str, object] = {
                "case": number,
                "effects": " + ".join(case.truth.names),
                "policy": policy,
                "trials": num,
                "action": " ".join(f"{v:g}" for v in following.tolist()),
                "lambda": grown.truth.non_centrality,
            }
            rows.append(row)
            problem = grown.problem
            model, count = counted(problem.model)
            start = time.process_time()
            try:
                criticism = Criticism(
                    model,
                    problem.prior,
                    problem.trials,
                    effects=problem.effects,
                    actions=problem.actions,
                    seed=number,
                )
                tracing = criticism.trace()
                chosen = None
                if policy == "chosen" and num < len(every):
                    chosen = criticism.next_action().action
            except Exception as error:  # a crash is a result of the benchmark
                row["failure"] = f"{type(error).__name__}: {error}"[:300]
                break
            world = case.truth.world
            stated = merged(world, tracing.probabilities)
            truth = merged(world, {true_name(world, *case.truth.names): 1.0})
            row |= {
                "cpu_seconds": time.process_time() - start,
                "trial_simulations": count(),
                "verdict": tracing.verdict,
                "top": next(iter(stated)) == next(iter(truth)),
                "probability": stated.get(next(iter(truth)), 0.0),
            }
            if num == len(every):
                break
            following = every[num]
            if chosen is not None:
                following = torch.as_tensor(chosen).float()
    return rows
