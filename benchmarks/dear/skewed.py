r"""Noise that is not Gaussian: beliefs beside stock sbi and the exact posterior.

    python -m benchmarks dear.skewed --seeds 3000 3006

Four trials of five numbers each, :math:`x_j = \mu_j g_j + .3 s`, with g a gamma
variable of shape 3 and mean one for each number and s Student's t of 2.5 degrees,
common to the numbers of a trial. The reference weighs draws around a belief by the
exact likelihood, the shift integrated on a grid; the divergence is that of normal fits.
Methods see as many parameter draws, with all trials simulated at each. Choices were
made at seeds below 100. Resumable; rows in benchmarks/dear/results/skewed.csv.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from scipy.stats import t as student
from torch import Tensor

from benchmarks.dear.run import stock
from benchmarks.rows import benchmark, column, grouped
from sbi_active.display import Table
from sbi_active.inference import RefinementOptions, refine
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.support import within_support

TIMES = torch.linspace(0.5, 2.5, 5)
ACTION = torch.tensor([[0.6], [1.0], [1.4], [1.8]])
TRUTH = torch.tensor([[1.5, 0.8, 0.7]])
SHAPE, SIZE, FREEDOM = 3.0, 0.3, 2.5  # of the gamma factor, and of the shift
NUM_DRAWS, NUM_REFERENCE, WIDER = 1_500, 4_000, 2.5  # the last, of the covariance


class Skewed:
    """A simulator whose noise is a gamma factor and a shift of all numbers."""

    prior = BoxUniform(torch.tensor([1.0, 0.2, 0.2]), torch.tensor([2.0, 2.0, 1.5]))

    def mean(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return outcomes without noise, shape (n, 5)."""
        rate = torch.exp(-theta[:, 1:2] * TIMES.to(theta))
        return action * (theta[:, :1] + rate + 0.5 * theta[:, 2:3] * TIMES.to(theta))

    def simulator(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return outcomes, shape (n, 5)."""
        mean = self.mean(theta, action)
        factor = torch.distributions.Gamma(SHAPE, SHAPE).sample(mean.shape)
        shift = torch.distributions.StudentT(FREEDOM).sample((len(theta), 1))
        return mean * factor + SIZE * shift

    def log_likelihood(self, theta: np.ndarray, x: Tensor) -> np.ndarray:
        """Return exact log likelihoods of all trials but for a constant, shape (n,)."""
        shift = np.linspace(-12, 12, 2401) * SIZE
        log_shift = student.logpdf(shift / SIZE, FREEDOM)
        total = np.zeros(len(theta))
        for action, observed in zip(ACTION, x.double().numpy(), strict=True):
            mean = self.mean(torch.from_numpy(theta), action[None].double()).numpy()
            for k, own in enumerate(mean):
                factor = (observed - shift[:, None]) / own
                with np.errstate(all="ignore"):
                    log_p = (SHAPE - 1) * np.log(factor) - SHAPE * factor - np.log(own)
                log_p = np.where(factor > 0, log_p, -np.inf).sum(1) + log_shift
                total[k] += np.logaddexp.reduce(log_p)
        return total


def judged(task: Skewed, belief: Any, x: Tensor) -> dict[str, float]:
    """Return the divergence of normal fits, nats, and the largest shift of a mean."""
    with forked_generators(1):
        z = belief.sample((NUM_DRAWS,)).double().numpy()
    mean, cov = z.mean(0), np.cov(z.T)
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(WIDER * cov)
    u = mean + rng.standard_normal((NUM_REFERENCE, len(mean))) @ root.T
    u = u[within_support(task.prior, torch.from_numpy(u).float()).numpy()]
    log_q = -0.5 * (np.linalg.solve(root, (u - mean).T) ** 2).sum(0)
    log_w = task.log_likelihood(u, x) - log_q
    weight = np.exp(log_w - log_w.max())
    weight /= weight.sum()
    exact = weight @ u
    spread = (weight[:, None] * (u - exact)).T @ (u - exact)
    off, precision = mean - exact, np.linalg.inv(cov)
    kl = np.trace(precision @ spread) - len(mean) + off @ precision @ off
    kl += np.linalg.slogdet(cov)[1] - np.linalg.slogdet(spread)[1]
    shift = float(np.abs(off / np.sqrt(np.diag(spread))).max())
    return {"kl": 0.5 * float(kl), "shift": shift}


def row_of(method: str, num: int, seed: int) -> dict[str, object]:
    """Return the error of a belief by a method, from so many histories."""
    task = Skewed()
    with forked_generators(derive_seed(seed, "real")):
        x = task.simulator(TRUTH.expand(len(ACTION), -1), ACTION)
    start = time.process_time()
    trust: object = ""
    if method == "refine":
        own = RefinementOptions(num_histories=num)
        belief = refine(
            *(task.simulator, task.prior, ACTION, x), settings=own, seed=seed
        )
        trust = belief.diagnostics.trustworthy
    else:
        trials = [*zip(ACTION, x, strict=True)]
        belief = stock(task, method, num * len(ACTION), trials, seed)
    cpu = time.process_time() - start
    return {**judged(task, belief, x), "trustworthy": trust, "cpu": cpu}


def table(rows: list[dict[str, str]]) -> str:
    """Return errors and cost, by histories and method."""
    lines = []
    groups = grouped(rows, "histories", "method")
    for key in sorted(groups):
        kl, shift, cpu = (column(groups[key], k) for k in ("kl", "shift", "cpu"))
        errors = f"{kl.mean():.3f} / {np.median(kl):.3f}", f"{shift.mean():.2f}"
        lines.append([*key, str(len(kl)), *errors, f"{cpu.mean():.1f}"])
    header = ["histories", "method", "seeds", "KL: mean / median", "shift [sd]"]
    return Table([*header, "CPU s"], lines).text()


main = benchmark(
    Path(__file__).parent / "results/skewed.csv",
    row_of,
    table,
    method=("refine", "TSNPE", "SNPE-C"),
    histories=(500, 3_000),
    seed=range(3000, 3006),
)
