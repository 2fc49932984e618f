"""Does a belief's flag follow its error?

A belief is bad where its mean is off by more than .3 standard deviations, or where the
KL divergence of normal fits is above .1: the flag is to say so. Resumable: a problem
that stands in ``rows.csv`` is not run again. Thresholds were chosen on seeds below 110,
regions of drawn noise on 500 to 508. Rows of seeds 200 to 209 are of the version before
these regions were widened, rows of 400 to 403 (drawn noise, three and four parameters)
of the version after. The reference is that of the oracles, tempered importance
sampling. The share of the prior in a belief is the least, of which one draw in 5,000
would decide the moments.

Problems by which a belief's flag is judged: two families, each of any size.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import benchmark
from tests.oracles.judging import Found, Limits, judged
from tests.oracles.noise import Normal
from tests.oracles.problem import Problem, box
from tests.oracles.problems import compartments
from tests.oracles.reference import answer
from tests.oracles.ways import refined

Array = NDArray[Any]


def oscillations(theta: Array, action: Array) -> Array:
    r"""Return a sum of damped oscillations at sixteen times.

    .. math::
        x(t) = \sum_j A_j e^{-t c_j} \cos(2 \pi f_j t), \qquad
        A_j = 1 + \theta_{2j} / 2, \; c_j = e^{\theta_{2j + 1}} / 4, \;
        f_j = .2 (j + 1),

    where a last parameter without a partner is an offset.

    Args:
        theta: Shape (n, d), within [-1, 1].
        action: Factor of the times less one, shape (n, 1).
    """
    n, d = theta.shape
    time = (1 + action) * np.linspace(0.1, 3.0, 16)
    x = np.zeros((n, 16)) + (theta[:, -1:] if d % 2 else 0.0)
    for j in range(d // 2):
        size, decay = 1 + theta[:, [2 * j]] / 2, np.exp(theta[:, [2 * j + 1]]) / 4
        x += size * np.exp(-time * decay) * np.cos(0.4 * np.pi * (j + 1) * time)
    return x


FAMILIES = "compartments", "oscillations"


def problem(family: str, dim: int, seed: int) -> Problem:
    """Return four trials of a family at a truth that is drawn.

    Args:
        family: One of ``FAMILIES``.
        dim: Number of parameters.
        seed: Seed of the truth and of the noise.
    """
    own = replace(compartments(dim), times=None)
    if family == "oscillations":
        own = replace(
            own,
            space=box([-1] * dim, [1] * dim),
            mean=oscillations,
            error=Normal(0.05),
        )
    rng = np.random.default_rng([dim, seed, len(family)])
    own = replace(own, truth=rng.uniform(-0.8, 0.8, dim), seed=seed)
    rows = np.repeat(own.truth[None], len(own.action), 0)
    clean = own.mean(rows, own.action)
    return replace(own, given=clean + own.error.sample(clean.shape, rng))


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
    seed=[*range(200, 210), *range(400, 404)],
)
