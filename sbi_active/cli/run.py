"""``sbi-active run TASK --out DIR``: a campaign on a task.

A task's own options follow ``--option``, as in ``sbi-active run box_collision --option
target=2 --option noise=0.01 --out DIR``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from sbi_active import __version__
from sbi_active.campaign import Campaign, CampaignOptions, Trial
from sbi_active.campaign.learning.methods import faithful_options, find_method
from sbi_active.cli.declared import declared_of_task, write_declared
from sbi_active.cli.loading import make_task
from sbi_active.cli.progress import Progress
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.plots import as_table, plot_rounds, save
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import Task  # pyright: ignore

SETTINGS = {"default": lambda _: CampaignOptions(), "faithful": faithful_options}


def run(arguments: argparse.Namespace) -> int:
    """Run a campaign on a task, and save its table, figure and results."""
    start = time.perf_counter()
    beliefs, rounds, exact_gains = [], [], []
    with Progress(arguments.rounds, arguments.method) as progress:
        progress.step("preparing the task")
        task = make_task(arguments.task, arguments.option)
        campaign = Campaign(
            task.simulator,
            task.prior,
            task.actions,
            method=arguments.method,
            seed=arguments.seed,
            options=_campaign_options(arguments),
            directory=(folder := _new_folder(arguments.out)),
        )
        declared = declared_of_task(arguments.task, arguments.option)
        write_declared(folder, declared)
        beliefs.append(campaign.belief)
        for index in range(arguments.rounds):
            progress.step("looking up what is exact")
            exact_gains.append(_exact_gain(task, campaign))
            progress.step("simulating, training and designing")
            trial = campaign.ask()
            progress.step("measuring")
            campaign.tell(
                task.real_system(
                    trial.action, seed=derive_seed(arguments.seed, "real", index)
                )
            )
            progress.step("updating the belief")
            beliefs.append(campaign.update())
            rounds.append(_round_record(task, campaign, exact_gains[-1]))
            progress.count()
        wall = time.perf_counter() - start
        progress.step("drawing and saving")
        figure_path = arguments.out / "loop.png"
        with forked_generators(arguments.seed, "figure"):
            figure = plot_rounds(
                beliefs,
                [t.design for t in campaign.history if t.design is not None],
                parameter_names=task.parameter_names,
                theta_true=task.theta_true,
                exact_gains=exact_gains,
            )
        save(figure, str(figure_path))
        _save(arguments, campaign, rounds, wall)
        campaign.close()
    print(_table(rounds))
    mean, sd = campaign.belief.mean, campaign.belief.variance.sqrt()
    for name, m, s, truth in zip(
        task.parameter_names, mean, sd, task.theta_true, strict=True
    ):
        print(f"{name}: {m:.4g} +- {s:.2g} (truth {truth:g})")
    diagnostics = getattr(campaign.belief, "diagnostics", Diagnostics())
    for warning in (*diagnostics.warnings, *diagnostics.network_warnings):
        print(f"note: {warning}")
    print(f"{wall:.1f} s; figure: {figure_path}; results: {arguments.out}")
    print(f"to go on with it: sbi-active ask {folder}")
    return 0


def _new_folder(out: Path) -> Path:
    """Return where the campaign is kept; those of earlier runs stay as they are."""
    numbered = (f"campaign-{k}" for k in itertools.count(2))
    names = itertools.chain(["campaign"], numbered)
    return next(out / name for name in names if not (out / name).exists())


def _campaign_options(arguments: argparse.Namespace) -> CampaignOptions:
    """Return the named setting with the sizes that were given."""
    options = SETTINGS[arguments.setting](arguments.method)
    sizes = {
        "num_simulations": arguments.simulations,
        "num_samples": arguments.samples,
    }
    options = replace(options, **{k: v for k, v in sizes.items() if v is not None})
    if arguments.iterations is not None:
        default = find_method(arguments.method).estimator
        estimator = options.density_estimator or default
        if not isinstance(estimator, MixtureDensity):
            raise ValueError(
                f"expected --iterations with a method that trains a mixture density; "
                f"got --method {arguments.method}; leave it out"
            )
        estimator = replace(estimator, num_iterations=arguments.iterations)
        options = replace(options, density_estimator=estimator)
    return options


def _exact_gain(task: Task, campaign: Campaign) -> torch.Tensor | None:
    """Return the exact gain of every candidate in the next round, where known."""
    reference = _reference(task, campaign.history)
    if reference is None:
        return None
    gain = reference.expected_information_gain(task.actions.values)
    return gain[0] if isinstance(gain, tuple) else gain


def _reference(task: Task, trials: Sequence[Trial]) -> Any:
    """Return exact inference from what was measured; an invalid trial counts."""
    used = [t for t in trials if t.status in ("ok", "invalid") and t.x is not None]
    if used:
        x = torch.stack([t.x for t in used if t.x is not None])
        return task.reference(torch.stack([t.action for t in used]), x)
    if not bool(task.theta_true.isfinite().all()):  # nobody knows it
        return None
    action = task.actions.values[:1]
    row = simulate(task.simulator, task.theta_true[None], action, seed=0)
    return task.reference(action[:0], row.x[:0])


def _round_record(
    task: Task, campaign: Campaign, exact_gain: torch.Tensor | None
) -> dict[str, Any]:
    """Return the figures of the last round."""
    trial = campaign.history[-1]
    assert trial.design is not None
    assert trial.x is not None
    index = trial.design.index
    log_prob = math.nan
    if bool(task.theta_true.isfinite().all()):
        log_prob = float(campaign.belief.log_prob(task.theta_true))
    record = {
        "round": len(campaign.history),
        "action": trial.action.tolist(),
        "status": trial.status,
        "x": [v if math.isfinite(v) else None for v in trial.x.flatten().tolist()],
        "eig": float(trial.design.expected_information_gain[index]),
        "eig_se": float(trial.design.standard_error[index]),
        "information_gained": trial.information_gained,
        "log_prob_true": log_prob,
        "num_simulations": trial.num_simulations,
        "seconds": trial.seconds,
        "cpu_seconds": trial.cpu_seconds,
    }
    if exact_gain is not None:
        exact = _reference(task, campaign.history)
        record["exact_eig"] = float(exact_gain[index])
        record["regret"] = float(exact_gain.max() - exact_gain[index])
        exact_log_prob = float(exact.log_prob(task.theta_true[None])[0])
        record["exact_log_prob_true"] = exact_log_prob
        record["gap"] = exact_log_prob - log_prob
    return record


def _table(rounds: Sequence[dict[str, Any]]) -> str:
    columns = {
        "round": lambda r: str(r["round"]),
        "action": lambda r: ", ".join(f"{a:g}" for a in r["action"]),
        "EIG": lambda r: f"{r['eig']:.2f} +- {r['eig_se']:.2f}",
        "exact EIG": lambda r: f"{r['exact_eig']:.2f}" if "exact_eig" in r else "-",
        "gained": lambda r: f"{r['information_gained']:.2f}",
        "log p(truth)": lambda r: f"{r['log_prob_true']:.2f}",
        "gap to exact": lambda r: f"{r['gap']:.2f}" if "gap" in r else "-",
        "time [s]": lambda r: f"{sum(r['seconds'].values()):.1f}",
    }
    rows = [[cell(r) for cell in columns.values()] for r in rounds]
    return as_table(rows, [*columns])


def _save(
    arguments: argparse.Namespace,
    campaign: Campaign,
    rounds: Sequence[dict[str, Any]],
    wall: float,
) -> None:
    from sbi_active.export import to_inference_data

    summary = {
        "task": arguments.task,
        "options": arguments.option,
        "method": arguments.method,
        "setting": arguments.setting,
        "seed": arguments.seed,
        "version": __version__,
        "seconds": wall,
        "rounds": [
            # JSON has no NaN, which is where there is no truth.
            {
                k: None if isinstance(v, float) and math.isnan(v) else v
                for k, v in r.items()
            }
            for r in rounds
        ],
    }
    (arguments.out / "result.json").write_text(
        json.dumps(summary, indent=2) + "\n", encoding="utf-8"
    )
    data = to_inference_data(campaign, seed=arguments.seed)
    data.to_netcdf(str(arguments.out / "inference_data.nc"))
