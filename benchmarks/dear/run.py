"""Campaigns with few simulations, beside the default and stock sbi with as many.

    python -m benchmarks dear --task numerical oscillator --seeds 2400 2404

The trials (actions, outcomes) of the campaign with a budget are given to the methods of
sbi, which simulate all executed actions at once and choose none: what is compared is
the belief. Truths are drawn from the prior at seeds from 2400 on. Resumable; one row a
round in benchmarks/dear/results/rows.csv, and the table is printed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.inference import NPE_C
from sbi.utils import RestrictedPrior, get_density_thresholder

from benchmarks.numerical.run import reference
from benchmarks.rounds import drawn_truth, played
from benchmarks.rows import benchmark, column, grouped
from sbi_active.campaign import Trial
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task

TASKS = ("numerical", "oscillator", "chain")
ROUNDS, DEFAULT = 4, "default"
PRICES = (0.0001, 0.001, 0.01, 0.1, 1.0, 10.0)  # CPU s of a simulation


def figures(task: Any, trials: list[Any], belief: Any) -> dict[str, float]:
    """Return gap at the truth and KL from the reference, nats."""
    exact = task.reference(*map(torch.stack, zip(*trials, strict=True)))
    draws, truth = exact.sample(1_000, seed=0), task.theta_true
    log_q = belief.log_prob(torch.cat([truth[None], draws.float()])).double()
    log_p = exact.log_prob(torch.cat([truth[None].double(), draws.double()]))
    return {
        "gap": float(log_p[0] - log_q[0]),
        "kl": float((log_p[1:] - log_q[1:]).mean()),
    }


def campaign(task: Any, per_round: int | None, seed: int) -> list[dict[str, Any]]:
    """Return a row a round of a campaign; None is the default's sizes."""
    options: dict[str, Any] = {"network": "on demand"}
    if per_round is not None:
        options = {"max_simulations": per_round * ROUNDS, "planned_trials": ROUNDS}
    spent, rows = 0, []
    for made, cpu in played(task, seed, ROUNDS, options=options):
        trial = made.history[-1]
        trials = [(t.action, t.x) for t in made.history]
        now = sum(t.num_simulations for t in made.history)
        if per_round is not None:
            now = made.state.meter.spent
        rows.append(
            {
                "round": len(trials),
                "action": " ".join(f"{v:g}" for v in trial.action.tolist()),
                **figures(task, trials, made.belief),
                "regret": regret(task, made.history),
                "num_simulations": now - spent,
                "cpu": cpu,
                "x": trial.x,
            }
        )
        spent = now
    return rows


def regret(task: Any, trials: Sequence[Trial]) -> float | None:
    """Return the exact information lost by the last action, where it is known."""
    if task.name != "numerical":
        return None
    actions = task.actions.values
    gain = reference(task, trials[:-1]).expected_information_gain(actions)
    chosen = (actions == trials[-1].action).all(1).int().argmax()
    return float(gain.max() - gain[chosen])


def stock(task: Any, method: str, num: int, trials: list[Any], seed: int) -> Any:
    """Return sbi's posterior of all trials by rounds of simulations at their actions.

    A row simulates every trial, so that num / len(trials) parameters are drawn, in two
    rounds: SNPE-C with atomic proposals, or TSNPE with a truncated prior.
    """
    action = torch.stack([a for a, _ in trials])
    x_o = torch.cat([x.flatten() for _, x in trials])[None]
    with forked_generators(derive_seed(seed, method, num, len(trials))):
        inference = NPE_C(task.prior, show_progress_bars=False)
        proposal: Any = task.prior
        posterior: Any = None
        for _ in range(2):
            theta = proposal.sample((max(num // len(trials) // 2, 20),))
            many = theta.repeat_interleave(len(action), 0)
            x = task.simulator(many, action.repeat(len(theta), 1))
            x = x.reshape(len(theta), -1)
            if method == "TSNPE":
                inference.append_simulations(theta, x)
                inference.train(force_first_round_loss=True, max_num_epochs=500)
            else:
                inference.append_simulations(theta, x, proposal=proposal)
                inference.train(max_num_epochs=500)
            posterior = inference.build_posterior().set_default_x(x_o)
            proposal = posterior
            if method == "TSNPE":
                accept = get_density_thresholder(
                    posterior, quantile=1e-4, num_samples_to_estimate_support=2_000
                )
                proposal = RestrictedPrior(task.prior, accept, sample_with="rejection")
        return posterior


def table(rows: list[dict[str, str]]) -> str:
    """Return figures by task and method, and the best method by price."""
    lines: list[list[str]] = []
    costs: dict[str, list[tuple[str, float, float, float]]] = {}
    for (task, method, per_round), own in grouped(
        rows, "task", "method", "per_round"
    ).items():
        last, kl = column(own, "gap", ROUNDS), column(own, "kl", ROUNDS)
        regret = column(own, "regret")
        regret = regret[np.isfinite(regret)]
        spent = None if method == "campaign" else ROUNDS
        used = column(own, "num_simulations", spent).mean()
        work = column(own, "cpu", spent).mean()
        lines.append(
            [
                *(task, method, per_round, str(len(last))),
                f"{np.median(last):.3f} / {last.mean():.3f}",
                f"{np.median(kl):.3f}",
                f"{regret.mean():.3f}" if len(regret) else "",
                *(f"{used:.0f}", f"{work:.1f}"),
            ]
        )
        name = f"{method} {per_round}"
        costs.setdefault(task, []).append((name, float(np.median(kl)), used, work))
    header = ["task", "method", "a round", "trials", "gap r4: median / mean"]
    header += ["median KL r4", "regret", "simulations", "CPU s a round"]
    text = [Table(header, lines).text(), ""]
    prices = [[task] for task in costs]
    for line, options in zip(prices, costs.values(), strict=True):
        good = [o for o in options if o[1] <= 0.2]
        for price in PRICES:
            if not good:  # none is worth its price
                line.append("none")
                continue
            best = min(good, key=lambda o: o[2] * price + o[3])
            line.append(f"{best[0]}: {best[2] * price + best[3]:.3g} s")
    text.append("cheapest round with a median KL <= .2 nat, by CPU s of a simulation:")
    text.append(Table(["task", *[f"{p:g} s" for p in PRICES]], prices).text())
    return "\n".join(text)


@lru_cache(1)
def drawn(name: str, per_round: str, seed: int) -> tuple[Any, list[dict[str, Any]]]:
    """Return a task whose truth is a draw of the prior, and a campaign's rows."""
    task = drawn_truth(get_task(name), seed)
    return task, campaign(task, None if per_round == DEFAULT else int(per_round), seed)


def rows_of(
    name: str, per_round: str, seed: int, method: str
) -> list[dict[str, Any]] | dict[str, Any]:
    """Return the rows of a campaign, or the last round's by a method of sbi."""
    task, rows = drawn(name, per_round, seed)
    if method == "campaign":
        return [{k: v for k, v in row.items() if k != "x"} for row in rows]
    trials = [
        (torch.tensor([float(v) for v in r["action"].split()]), r["x"]) for r in rows
    ]
    start, size = time.process_time(), int(per_round)
    belief = stock(task, method, size * ROUNDS, trials, seed)
    cpu = time.process_time() - start
    more = {"round": ROUNDS, "num_simulations": size, "cpu": cpu / ROUNDS}
    return {**figures(task, trials, belief), **more}


main = benchmark(
    Path(__file__).parent / "results" / "rows.csv",
    rows_of,
    table,
    skip=lambda task, size, seed, method: size == DEFAULT and method != "campaign",
    task=TASKS,
    per_round=("500", "250", "1000", DEFAULT),
    seed=range(2400, 2405),
    method=("campaign", "TSNPE", "SNPE-C"),
)
