"""``sbi-active run TASK --out DIR``: a campaign on a task, whose truth is known.

A task's own options follow ``--option``, as in ``sbi-active run box_collision --option
target=2 --option noise=0.01 --out DIR``.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.declared import declared_of_task, write_declared
from sbi_active.cli.given import make_task
from sbi_active.cli.trials import status, sum_up_campaign
from sbi_active.display.figures import save
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import Task  # pyright: ignore

COLUMNS = ("expected_information", "exact_information", "information_gained", "seconds")


def run(
    task: str,
    *,
    out: Path,
    method: str,
    rounds: int,
    seed: int,
    option: Sequence[str],
    simulations: int | None,
) -> None:
    """Run a campaign on a task, and save its table and figure."""
    start = time.perf_counter()
    problem = make_task(task, option)
    options = CampaignOptions()
    if simulations is not None:
        options = replace(options, num_simulations=simulations)
    campaign = Campaign(
        problem.simulator,
        problem.prior,
        problem.actions,
        method=method,
        seed=seed,
        options=options,
        directory=(folder := _new_folder(out)),
        show_progress=sys.stderr.isatty(),
    )
    write_declared(folder, declared_of_task(task, option))
    gains = []
    for index in tqdm(range(rounds), desc=method, unit="round"):
        gains.append(_exact_gain(problem, campaign))
        action = campaign.ask().action
        real = derive_seed(seed, "real", index)
        campaign.tell(problem.real_system(action, seed=real))
        campaign.update()
    with forked_generators(seed, "figure"):
        figure = campaign.plot(theta_true=problem.theta_true)
    save(figure, str(out / "loop.png"))
    sum_up_campaign(campaign)
    campaign.close()
    frame = campaign.to_dataframe()
    frame["exact_information"] = [
        None
        if gain is None or trial.design is None
        else float(gain[trial.design.index])
        for gain, trial in zip(gains, campaign.history, strict=True)
    ]
    frame.to_csv(out / "trials.csv")
    labels = frame.columns[2 : 2 + campaign.actions.action_dim]
    shown = frame.reset_index().filter(items=["trial", *labels, *COLUMNS])
    names = zip(problem.parameter_names, problem.theta_true, strict=True)
    print(Table.of(shown).text())
    print(f"\n{status(campaign).text}")
    print(f"the truth: {', '.join(f'{name} = {value:g}' for name, value in names)}")
    wall = time.perf_counter() - start
    print(f"{wall:.1f} s; figure: {out / 'loop.png'}; trials: {out / 'trials.csv'}")
    print(f"to go on with it: sbi-active ask {folder}")


def _new_folder(out: Path) -> Path:
    """Return where the campaign is kept; those of earlier runs stay as they are."""
    numbered = (f"campaign-{k}" for k in itertools.count(2))
    names = itertools.chain(["campaign"], numbered)
    return next(out / name for name in names if not (out / name).exists())


def _exact_gain(task: Task, campaign: Campaign) -> torch.Tensor | None:
    """Return the exact gain of every candidate in the next round, where known."""
    reference = reference_of(task, campaign.history)
    if reference is None:
        return None
    gain = reference.expected_information_gain(task.actions.values)
    return gain[0] if isinstance(gain, tuple) else gain


def reference_of(task: Task, trials: Sequence[Any]) -> Any:
    """Return exact inference from what was measured; an invalid trial counts.

    Args:
        task: Task with a ``reference``.
        trials: Trials of the campaign.
    """
    used = [t for t in trials if t.status in ("ok", "invalid") and t.x is not None]
    if used:
        x = torch.stack([t.x for t in used])
        return task.reference(torch.stack([t.action for t in used]), x)
    if not task.theta_true.isfinite().all():  # nobody knows the truth
        return None
    action = task.actions.values[:1]
    row = simulate(task.simulator, task.theta_true[None], action, seed=0)
    return task.reference(action[:0], row.x[:0])
