"""Does a belief's flag follow its error?

A belief is bad where its mean is off by more than .3 standard deviations, or where the
KL divergence of normal fits is above .1: the flag is to say so. Resumable: a problem
that stands in ``rows.csv`` is not run again. Thresholds were chosen on seeds below 110,
regions of drawn noise on 500 to 508. Rows of seeds 200 to 209 are of the version before
these regions were widened, rows of 400 to 403 (drawn noise, three and four parameters)
of the version after. The reference is that of the oracles, tempered importance
sampling. The share of the prior in a belief is the least, of which one draw in 5,000
would decide the moments.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.flag.problems import FAMILIES, problem
from benchmarks.rows import benchmark
from tests.oracles.judging import Found, Limits, judged
from tests.oracles.reference import answer
from tests.oracles.ways import refined

NUM, FINAL, FEWEST_EFFECTIVE = 4_000, 12_000, 500.0


def row_of(family: str, noise: str, dim: int, seed: int) -> dict[str, object]:
    """Return a belief's error and what its flag says.

    Args:
        family: Family of the problem.
        noise: "declared", or "drawn" by the simulator.
        dim: Number of parameters.
        seed: Seed of the problem and of the belief.
    """
    own, num_rows = problem(family, dim, seed).counted()
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulator = own.simulator(is_declared=noise == "declared")
        found: Found = refined(own, simulator, seed)
    spent = time.process_time() - start
    used = sum(num_rows)
    known = answer(own, num=NUM, final=FINAL, seed=seed)
    result = judged(own, known, found)
    return {
        "belief": found.kind,
        "kl": f"{result.kl:.4f}",
        "shift": f"{result.shift:.3f}",
        "trustworthy": found.trustworthy,
        "effective": f"{known.effective:.0f}",
        "num_simulations": used,
        "cpu_seconds": f"{spent:.1f}",
    }


def table_of(table: Sequence[dict[str, str]]) -> Iterator[str]:
    """Yield the table: bad beliefs and good ones, and how many are flagged.

    Args:
        table: Rows as they are written.
    """
    most = Limits()
    yield "family, noise | beliefs | bad, flagged | good, flagged | median KL, worst"
    for key in dict.fromkeys((r["family"], r["noise"]) for r in table):
        own = [r for r in table if (r["family"], r["noise"]) == key]
        own = [r for r in own if float(r["effective"]) >= FEWEST_EFFECTIVE]
        bad = [
            r for r in own if float(r["shift"]) > most.shift or float(r["kl"]) > most.kl
        ]
        good = [r for r in own if r not in bad]
        divergence = sorted(float(r["kl"]) for r in own)
        yield (
            f"{', '.join(key)} | {len(own)} | {len(bad)}, "
            f"{sum(r['trustworthy'] == 'False' for r in bad)} | {len(good)}, "
            f"{sum(r['trustworthy'] == 'False' for r in good)} | "
            f"{divergence[len(own) // 2]:.3f}, {divergence[-1]:.2f}"
        )


main = benchmark(
    Path(__file__).parent / "rows.csv",
    row_of,
    lambda rows: "\n".join(table_of(rows)),
    family=FAMILIES,
    noise=("declared", "drawn"),
    dim=(3, 4, 6),
    seed=range(200, 210),
)
