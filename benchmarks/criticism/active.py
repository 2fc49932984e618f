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

Names under which effects are counted: equivalent ones as one.

How fast two policies learn, from the rows of chosen and random trials.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from benchmarks.criticism.cases import Case, extend
from benchmarks.criticism.problem import counted
from benchmarks.criticism.worlds import World, get_world
from sbi_active import InformationGainDesigner
from sbi_active.criticism import Criticism


def true_name(world: World, effects: str) -> str:
    """Return the name that the loop should give a single truth."""
    if effects == world.scatter.name:
        return "scatter"
    return "none" if effects in world.equivalent("none") else effects


def merged(world: World, probabilities: Mapping[str, float]) -> dict[str, float]:
    """Return probabilities, most likely first, equivalent effects counted as one."""
    total: dict[str, float] = {}
    for name, probability in probabilities.items():
        key = min(world.equivalent(name)) if name != "none" else "none"
        key = "none" if name in world.equivalent("none") else key
        total[key] = total.get(key, 0.0) + probability
    return dict(sorted(total.items(), key=lambda item: -item[1]))


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
        return [_row(case, "random")]
    starts = {"random": every[:START], "chosen": first_actions(case.truth.world.name)}
    for policy, action in starts.items():
        grown = Case(case.problem, replace(case.truth, action=action[:-1]))
        grown = extend(grown, action[-1])
        for num in range(START, len(every) + 1):
            rows.append(_row(grown, policy))
            start = time.process_time()
            criticism, scores = _verdict(grown, number)
            action = every[num : num + 1]
            if policy == "chosen" and len(action):
                following = criticism.next_action(beyond=False).action
                action = action if following is None else torch.as_tensor(following)
            rows[-1] |= {"cpu_seconds": time.process_time() - start, **scores}
            if num < len(every):
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


def _row(case: Case, policy: str) -> dict[str, object]:
    action = case.truth.action
    return {
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


#: Scores of a row, by what a table calls them.
SCORES = {
    "top-1": lambda row: row["top"] == "True",
    "top-1 among the effects": lambda row: row["place"] == "1",
    "probability of the truth": lambda row: float(row["probability"]),
}
NUM_RESAMPLES = 400


@dataclass(frozen=True)
class Curves:
    """Scores of detectable cases, by the number of trials.

    Attributes:
        trials: Numbers of trials, shape (t,).
        values: By score and policy, shape (cases, t).
    """

    trials: list[int]
    values: dict[tuple[str, str], np.ndarray]

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, str]]) -> Curves:
        """Take the cases that are detectable and ran through with both policies."""
        trials = sorted({int(r["trials"]) for r in rows if r.get("verdict")})
        found = {(r["case"], r["policy"], int(r["trials"])): r for r in rows}
        cases = []
        for case in dict.fromkeys(r["case"] for r in rows):
            keys = [(case, p, t) for p in ("random", "chosen") for t in trials]
            if trials and all(k in found for k in keys):
                last = found[case, "random", trials[-1]]
                cases += [case] if float(last["lambda"]) > DETECTABLE else []
        values = {
            (name, policy): np.array(
                [[score(found[c, policy, t]) for t in trials] for c in cases], float
            )
            for name, score in SCORES.items()
            for policy in ("random", "chosen")
        }
        return cls(trials, values)

    @property
    def num_cases(self) -> int:
        """Number of cases."""
        return len(self.values[next(iter(SCORES)), "random"])

    def mean(self, score: str, policy: str) -> dict[int, float]:
        """Return the mean score by the number of trials."""
        means = self.values[score, policy].mean(0)
        return dict(zip(self.trials, means.tolist(), strict=True))

    def matched(self, score: str, num: int, cases: np.ndarray | None = None) -> float:
        """Return how many chosen trials reach the mean score of random ones.

        Interpolated between numbers of trials along the largest mean so far; infinite
        where they do not reach it.

        Args:
            score: One of ``SCORES``.
            num: Of random trials.
            cases: Rows of the values, shape (n,); None takes each once.
        """
        some = np.arange(self.num_cases) if cases is None else cases
        random, chosen = (
            self.values[score, policy][some].mean(0) for policy in ("random", "chosen")
        )
        level = random[self.trials.index(num)]
        best = np.maximum.accumulate(chosen)
        reached = np.flatnonzero(best >= level - 1e-12)
        if not len(reached):
            return np.inf
        k = int(reached[0])
        if k == 0:
            return float(self.trials[0])
        share = (level - best[k - 1]) / (best[k] - best[k - 1])
        return float(self.trials[k - 1] + share * (self.trials[k] - self.trials[k - 1]))

    def interval(self, score: str) -> tuple[str, str]:
        """Return the 90 % bootstrap interval of the ratio at the last number."""
        rng, last = np.random.default_rng(0), self.trials[-1]
        draws = rng.integers(self.num_cases, size=(NUM_RESAMPLES, self.num_cases))
        ratio = np.sort([self.matched(score, last, d) / last for d in draws])
        ends = (ratio[int(NUM_RESAMPLES * q)] for q in (0.05, 0.95))
        low, high = (f"{v:.2f}" if np.isfinite(v) else "not reached" for v in ends)
        return low, high
