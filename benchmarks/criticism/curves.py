"""How fast two policies learn, from the rows of chosen and random trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.criticism.active import DETECTABLE

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
        trials = sorted({int(r["trials"]) for r in rows if r["verdict"]})
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
