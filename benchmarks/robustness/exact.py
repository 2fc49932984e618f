r"""Linear-Gaussian problems with a closed form: the error of a belief and what it says.

    python -m benchmarks robustness.exact
    python -m benchmarks robustness.exact --histories 200
    python -m benchmarks robustness.exact --summary

Three trials of

.. math::
    x = (A_0 + \xi A_1) \theta + e, \qquad e \sim \mathcal N(0, .5^2 I),

each passed to ``ASBI.update`` with the simulator, at 2 to 20 parameters and 2 to 200
numbers. The prior is standard normal, so that the posterior is Gaussian. With
``--histories``, fewer simulations than by default, so that beliefs are wrong and shall
say so. Columns of ``results/exact.csv``:

- ``kl``: KL(exact || belief) in nats, by 4,000 draws of the exact posterior;
  ``kl_error`` is its standard error;
- ``error_nats``: the library's own estimate of the first, where it gives one;
- ``trustworthy``, ``assumptions`` (those that do not hold), ``cpu_seconds``.

Seeds from 100 on served to calibrate the diagnostics; the table is of seeds 0 to 4.
Resumable: a problem that has a row is not run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from attrs import evolve
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from benchmarks.rows import benchmark, grouped
from sbi_active import ASBI, RefinementOptions
from sbi_active.inference import Belief
from sbi_active.seeding import derive_seed, forked_generators

DIMS = (2, 4, 6, 8, 10, 15, 20)
SIZES = (2, 10, 30, 80, 200)
ACTIONS = ((-1.0,), (0.0,), (1.0,))
SD = 0.5
NUM_DRAWS = 4_000
RESULTS = Path(__file__).parent / "results" / "exact.csv"


@dataclass(frozen=True)
class Problem:
    """Three trials and their exact posterior.

    Attributes:
        simulator: ``simulator(theta, action)``, theta (n, d) to x (n, size).
        prior: Of theta.
        action: Shape (3, 1).
        x: Shape (3, size).
        exact: The posterior of all three.
    """

    simulator: Callable[[Tensor, Tensor], Tensor]
    prior: Distribution
    action: Tensor
    x: Tensor
    exact: MultivariateNormal

    @staticmethod
    def draw(dim: int, size: int, seed: int) -> Problem:
        """Return the problem of a seed."""
        with forked_generators(derive_seed(seed, "exact", dim, size)):
            base, slope = torch.randn(2, size, dim).double() / dim**0.5
            truth = torch.randn(1, dim).double()
            action = torch.tensor(ACTIONS)

            def simulator(theta: Tensor, action: Tensor) -> Tensor:
                # One product for each action: in batches of any size the same numbers.
                wide = theta.double()
                mean = wide @ base.T + action.double() * (wide @ slope.T)
                return mean + SD * torch.randn_like(mean)

            x = simulator(truth.expand(len(action), -1), action)
        design = torch.cat([base + a * slope for a in action.double()])
        precision = design.T @ design / SD**2 + torch.eye(dim).double()
        covariance = torch.linalg.inv(precision)
        covariance = 0.5 * (covariance + covariance.T)
        mean = covariance @ design.T @ x.flatten() / SD**2
        exact = MultivariateNormal(mean, covariance)
        normal = MultivariateNormal(torch.zeros(dim), torch.eye(dim))
        return Problem(simulator, normal, action, x, exact)

    def infer(self, seed: int, num_histories: int | None = None) -> Belief:
        """Return the belief after the trials, one update each."""
        settings = RefinementOptions()
        if num_histories is not None:
            settings = evolve(settings, num_histories=num_histories)
        inference = ASBI(self.prior, show_progress_bars=False)
        trials = list(zip(self.action, self.x, strict=True))
        for k, (action, x) in enumerate(trials):
            belief = inference.update(
                x.float(),
                action=action,
                simulator=self.simulator,
                refinement=settings,
                seed=derive_seed(seed, k),
            )
        return belief

    def divergence(self, belief: Belief) -> float:
        """Return the Kullback-Leibler divergence, nats."""
        with forked_generators(0, "divergence"):
            theta = self.exact.sample(torch.Size([NUM_DRAWS]))
        ratio = self.exact.log_prob(theta) - belief.log_prob(theta.float()).double()
        return float(ratio.mean())


def row_of(
    prior: str, histories: str, dim: int, size: int, seed: int
) -> Mapping[str, object]:
    """Return the error of a belief and what it says, with so many histories or all."""
    start = time.process_time()
    problem = Problem.draw(dim, size, seed)
    belief = problem.infer(seed, int(histories) if histories else None)
    seconds = time.process_time() - start
    return {
        "kl": f"{problem.divergence(belief):.4g}",
        "trustworthy": belief.diagnostics.trustworthy,
        "cpu_seconds": f"{seconds:.1f}",
    }


def summary(rows: list[dict[str, str]]) -> str:
    """Return the lines of each prior and number of histories."""
    groups = grouped(rows, "prior", "histories").items()
    parts = [
        "\n".join([f"{prior} prior, {num or 'all'} histories", *lines_of(own)])
        for (prior, num), own in groups
    ]
    return "\n\n".join(parts)


def lines_of(found: list[dict[str, str]]) -> Iterator[str]:
    """Yield the table of median and largest KL, then what the flag says of it."""
    crashed = [row for row in found if row.get("failure")]
    ended = [row for row in found if not row.get("failure")]
    yield f"problems {len(found)}, crashes {len(crashed)}"
    yield f"{'KL: median (largest)':<20}" + "".join(
        f"{f'{n} numbers':>18}" for n in SIZES
    )
    for dim in DIMS:
        cells = []
        for size in SIZES:
            at = [r for r in ended if (r["dim"], r["size"]) == (str(dim), str(size))]
            kl = [float(row["kl"]) for row in at]
            cells.append(f"{np.median(kl):.3f} ({max(kl):.3f})" if kl else "-")
        yield f"{f'{dim} parameters':<20}" + "".join(f"{cell:>18}" for cell in cells)
    for name, low, high, said in (
        ("KL > .5", 0.5, np.inf, "False"),
        ("KL < .1", -np.inf, 0.1, "True"),
        ("KL between", 0.1, 0.5, "True"),
    ):
        among = [row for row in ended if low < float(row["kl"]) < high]
        agree = [row for row in among if row["trustworthy"] == said]
        yield f"{name}: trustworthy is {said} in {len(agree)} of {len(among)}"


main = benchmark(
    RESULTS,
    row_of,
    summary,
    may_fail=True,
    prior=("gaussian",),
    histories=("", "200"),
    dim=DIMS,
    size=SIZES,
    seed=range(5),
)
