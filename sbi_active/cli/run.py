"""``sbi-active run TASK --out DIR``: a campaign on a task.

A task's own options follow ``--option``, as in ``sbi-active run box_collision --option
target=2 --option noise=0.01 --out DIR``.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from sbi_active import __version__
from sbi_active.campaign import Campaign, CampaignOptions, Trial
from sbi_active.campaign.learning.methods import faithful_options, find_method
from sbi_active.cli.declared import declared_of_task, write_declared
from sbi_active.cli.given import make_task
from sbi_active.cli.output import as_json
from sbi_active.cli.trials import described, status, sum_up_campaign
from sbi_active.display.figures import save
from sbi_active.display.table import Table
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import Task  # pyright: ignore

SETTINGS = {"default": lambda _: CampaignOptions(), "faithful": faithful_options}
#: Columns of the table: what is written for a round, and how.
COLUMNS = {
    "round": ("round", "{}"),
    "action": ("action", "{}"),
    "EIG": ("eig", "{:.2f}"),
    "+-": ("eig_se", "{:.2f}"),
    "exact EIG": ("exact_eig", "{:.2f}"),
    "gained": ("information_gained", "{:.2f}"),
    "log p(truth)": ("log_prob_true", "{:.2f}"),
    "gap to exact": ("gap", "{:.2f}"),
    "time [s]": ("wall", "{:.1f}"),
}


def run(
    task: str,
    *,
    out: Path,
    method: str,
    rounds: int,
    seed: int,
    option: Sequence[str],
    setting: str,
    **sizes: int | None,
) -> None:
    """Run a campaign on a task, and save its table, figure and results."""
    start = time.perf_counter()
    problem = make_task(task, option)
    campaign = Campaign(
        problem.simulator,
        problem.prior,
        problem.actions,
        method=method,
        seed=seed,
        options=_campaign_options(setting, method, **sizes),
        directory=(folder := _new_folder(out)),
        show_progress=sys.stderr.isatty(),
    )
    write_declared(folder, declared_of_task(task, option))
    records = []
    for index in tqdm(range(rounds), desc=method, unit="round"):
        gain = _exact_gain(problem, campaign)
        action = campaign.ask().action
        real = derive_seed(seed, "real", index)
        campaign.tell(problem.real_system(action, seed=real))
        campaign.update()
        records.append(_record(problem, campaign, gain))
    wall = time.perf_counter() - start
    with forked_generators(seed, "figure"):
        figure = campaign.plot(theta_true=problem.theta_true)
    save(figure, str(out / "loop.png"))
    said = {"task": task, "options": [*option], "method": method}
    said |= {"setting": setting, "seed": seed, "version": __version__}
    _save(out, campaign, {**said, "seconds": wall, "rounds": records}, seed)
    sum_up_campaign(campaign)
    campaign.close()
    names = zip(problem.parameter_names, problem.theta_true, strict=True)
    print(_table(records))
    print(f"\n{status(campaign).text}")
    print(f"the truth: {', '.join(f'{name} = {value:g}' for name, value in names)}")
    print(f"{wall:.1f} s; figure: {out / 'loop.png'}; results: {out}")
    print(f"to go on with it: sbi-active ask {folder}")


def _new_folder(out: Path) -> Path:
    """Return where the campaign is kept; those of earlier runs stay as they are."""
    numbered = (f"campaign-{k}" for k in itertools.count(2))
    names = itertools.chain(["campaign"], numbered)
    return next(out / name for name in names if not (out / name).exists())


def _campaign_options(
    setting: str,
    method: str,
    *,
    simulations: int | None,
    samples: int | None,
    iterations: int | None,
) -> CampaignOptions:
    """Return the named setting with the sizes that were given."""
    options = SETTINGS[setting](method)
    sizes = {"num_simulations": simulations, "num_samples": samples}
    options = replace(options, **{k: v for k, v in sizes.items() if v is not None})
    if iterations is None:
        return options
    estimator = options.density_estimator or find_method(method).estimator
    if not isinstance(estimator, MixtureDensity):
        raise ValueError(
            f"expected --iterations with a method that trains a mixture density; got "
            f"--method {method}; leave it out"
        )
    estimator = replace(estimator, num_iterations=iterations)
    return replace(options, density_estimator=estimator)


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
    if not task.theta_true.isfinite().all():  # nobody knows the truth
        return None
    action = task.actions.values[:1]
    row = simulate(task.simulator, task.theta_true[None], action, seed=0)
    return task.reference(action[:0], row.x[:0])


def _record(
    task: Task, campaign: Campaign, exact_gain: torch.Tensor | None
) -> dict[str, Any]:
    """Return the figures of the last round; JSON has no NaN, but null."""
    trial = campaign.history[-1]
    assert trial.design is not None
    index, truth = trial.design.index, task.theta_true
    known = truth.isfinite().all()
    log_prob = float(campaign.belief.log_prob(truth)) if known else float("nan")
    record = {
        "round": len(campaign.history),
        **described(campaign, trial),
        "eig": float(trial.design.expected_information_gain[index]),
        "eig_se": float(trial.design.standard_error[index]),
        "log_prob_true": log_prob,
        "num_simulations": trial.num_simulations,
        "seconds": trial.seconds,
        "cpu_seconds": trial.cpu_seconds,
    }
    if exact_gain is not None:
        exact = float(_reference(task, campaign.history).log_prob(truth[None])[0])
        record["exact_eig"] = float(exact_gain[index])
        record["regret"] = float(exact_gain.max() - exact_gain[index])
        record |= {"exact_log_prob_true": exact, "gap": exact - log_prob}
    return as_json(record)


def _table(records: Sequence[dict[str, Any]]) -> str:
    def cell(record: dict[str, Any], name: str, form: str) -> str:
        shown = {**record, "wall": sum(record["seconds"].values())}
        shown["action"] = ", ".join(f"{a:g}" for a in record["action"])
        return "-" if shown.get(name) is None else form.format(shown[name])

    rows = [[cell(record, *c) for c in COLUMNS.values()] for record in records]
    return Table([*COLUMNS], rows).text()


def _save(out: Path, campaign: Campaign, summary: dict[str, Any], seed: int) -> None:
    from sbi_active.export import to_inference_data

    text = json.dumps(summary, indent=2) + "\n"
    (out / "result.json").write_text(text, encoding="utf-8")
    to_inference_data(campaign, seed=seed).to_netcdf(str(out / "inference_data.nc"))
