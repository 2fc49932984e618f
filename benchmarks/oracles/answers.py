"""Make the answers of the oracles again, and say how far they are from the committed.

A closed form, or long importance sampling: rounds of 6,000 draws find a proposal, of
which 200,000 give the answer. From ten parameters on, a posterior along which a
parameter is hardly seen needs four times as many a round.
"""

from __future__ import annotations

from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import answer, answers, write

NUM, FINAL, MANY = 6_000, 200_000, 10


def main(
    *, problems: list[str] | None = None, seed: int = 1, keep: bool = False
) -> None:
    """Compute answers and print the log evidence beside the committed one.

    Args:
        problems: Names of problems; all by default.
        seed: Seed of all draws.
        keep: Whether to write them in place of the committed ones.
    """
    found = dict(answers())
    for name in problems or PROBLEMS:
        own = PROBLEMS[name]()
        num = 4 * NUM if own.dim >= MANY else NUM
        new, old = answer(own, num=num, final=FINAL, seed=seed), found.get(name)
        before = "none" if old is None else f"{old.log_evidence:.4f} +- {old.error:.4f}"
        print(
            f"{name}: log Z {before} -> {new.log_evidence:.4f} +- {new.error:.4f}, "
            f"{new.effective:.0f} effective draws",
            flush=True,
        )
        found[name] = new
    if keep:
        write(found)
