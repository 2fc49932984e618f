"""``sbi-active check MODULE:FUNCTION``: look a simulator over before a campaign."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.given import problem_of
from sbi_active.cli.output import say
from sbi_active.seeding import forked_generators
from sbi_active.simulation import simulate
from sbi_active.simulation.check import check_simulator
from sbi_active.simulation.workers.settings import Workers

MANY_ACTIONS = 50  # that stand for a space without a list, to count simulations
LONG = 20.0  # seconds of simulation a round, beside which learning counts little


def check(*, rows: int, rounds: int, workers: int, seed: int, **problem: Any) -> int:
    """Look a simulator over; status 1 where a campaign cannot run."""
    model, prior, actions, _ = problem_of(**problem)
    say("running the simulator")
    report = check_simulator(
        model,
        prior,
        actions,
        num_rows=rows,
        num_simulations=_campaign_size(actions, rounds),
        workers=workers,
        seed=seed,
    )
    # Where simulations take longer than this, they are what a campaign takes.
    is_short = 60 * (report.minutes or 0.0) <= LONG * rounds
    if report.is_ready and is_short:
        say("timing a round")
        try:
            seconds = _time_round(model, prior, actions, workers, seed)
            report = replace(report, seconds_round=seconds, num_rounds=rounds)
        except Exception as error:  # whatever a campaign meets is the finding
            report = replace(report, defects=(f"a round of a campaign fails: {error}",))
    print(report)
    return 0 if report.is_ready else 1


def _time_round(
    simulator: Any,
    prior: Distribution,
    actions: ActionSpace,
    workers: int,
    seed: int,
) -> float:
    """Return wall seconds of a round on an outcome that the prior allows."""
    options = CampaignOptions(workers=Workers(workers))
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the round is thrown away
        campaign = Campaign(simulator, prior, actions, seed=seed, options=options)
        action = campaign.ask().action[None]
        with forked_generators(seed, "truth"):
            theta = prior.sample(torch.Size([1])).float()
        campaign.tell(simulate(simulator, theta, action, seed=seed).x[0])
        campaign.update()
    return time.perf_counter() - start


def _campaign_size(actions: ActionSpace, num_rounds: int) -> int:
    """Return the most simulations that the default options allow.

    A round trains, designs over all actions, and refines on the trials so far.
    """
    options = CampaignOptions()
    values = getattr(actions, "values", None)
    num_actions = MANY_ACTIONS if values is None else len(values)
    trials = num_rounds * (num_rounds + 1) // 2
    a_round = options.num_simulations + num_actions * options.num_samples
    return num_rounds * a_round + trials * options.refinement.num_histories
