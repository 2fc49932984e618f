"""Simulation-based calibration of every way whose run takes some seconds.

Parameters are drawn from the prior and trials simulated, 200 times a problem; the rank
of the truth among a belief's draws is then uniform. Other networks are left out:
training one for each draw takes hours, and sbi tests them. Resumable. Talts et al.
(2018), arXiv:1804.06788.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from scipy.stats import kstest

from benchmarks.rows import benchmark
from sbi_active.display.table import Table
from tests.oracles.problem import Problem
from tests.oracles.problems import PROBLEMS
from tests.oracles.ways import WAYS

CASES = ("linear_3_10", "edge")
CALIBRATED = {
    "refine": CASES,
    "refine, noise drawn": CASES,
    "max_simulations=1000": CASES,
    "close_loop, bare model": CASES,
    "identify": ("compartments_3", "decay"),
    "least squares + importance sampling": CASES,
    "RobustASBI": ("linear_1_1",),
}


def drawn(name: str, draw: int) -> Problem:
    """Return a problem whose truth is a draw of the prior.

    Args:
        name: Name of the problem.
        draw: Number of the draw, its seed.
    """
    own = PROBLEMS[name]()
    u = np.random.default_rng([draw, len(name)]).standard_normal((1, own.dim))
    return replace(own, truth=own.to_theta(u)[0], seed=10_000 + draw)


def row_of(name: str, way: str, draw: int) -> dict[str, object]:
    """Return the rank of each parameter's truth, between 0 and 1."""
    own, start = drawn(name, draw), time.process_time()
    simulator = own.simulator(is_declared=WAYS[way].is_declared)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.manual_seed(draw)
        found = WAYS[way].run(own, simulator, draw)
    ranks = (found.theta < own.truth).mean(0)
    return {
        "ranks": " ".join(f"{rank:.4f}" for rank in ranks),
        "trustworthy": found.trustworthy,
        "cpu_seconds": round(time.process_time() - start, 2),
    }


def text(known: list[dict[str, str]]) -> str:
    """Return the table: is the rank of each parameter uniform?"""
    shares = ("p-value of each parameter", "in the central 90 %")
    lines = []
    for name, way in dict.fromkeys((r["problem"], r["way"]) for r in known):
        own = [r for r in known if (r["problem"], r["way"]) == (name, way)]
        ranks = np.array([[float(v) for v in r["ranks"].split()] for r in own])
        levels = [kstest(column, "uniform").pvalue for column in ranks.T]
        inside = ((ranks > 0.05) & (ranks < 0.95)).mean()
        shown = ", ".join(f"{level:.2f}" for level in levels)
        lines.append((name, way, len(own), shown, f"{inside:.3f}"))
    return Table(("problem", "way", "draws", *shares), lines).markdown()


main = benchmark(
    Path(__file__).with_name("ranks.csv"),
    row_of,
    text,
    skip=lambda problem, way, draw: problem not in CALIBRATED[way],
    problem=dict.fromkeys(chain(*CALIBRATED.values())),
    way=CALIBRATED,
    draw=range(200),
)
