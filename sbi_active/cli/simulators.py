"""Commands on simulators: run a task, check one, fill a bank; and bring files up."""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import click

from sbi_active.cli import declare as cli
from sbi_active.cli.output import say
from sbi_active.cli.record import answer_of, sum_up_campaign
from sbi_active.cli.trusted import write_declared

MANY_ACTIONS = 50  # that stand for a space without a list, to count simulations
LONG = 20.0  # seconds of simulation a round, beside which learning counts little
#: Rows that are drawn and simulated at once. Part of the definition of a bank's theta
#: and action given a seed, so it is never a setting.
BLOCK = 1_000

bank = click.Group(
    "bank", help="Simulate into a bank, and inspect one.", no_args_is_help=False
)
cli.program.add_command(bank)


@cli.command(
    cli.argument("task", "TASK", click.Choice(cli.TASKS)),
    *(cli.METHOD, cli.ROUNDS, cli.SEED, cli.OF_TASK, *cli.OF_CAMPAIGN),
    cli.option("--out", "folder for the results", cli.FOLDER, "DIR", required=True),
)
def run(
    task: str, out: Path, method: str, rounds: int, seed: int, option: Any, **given: Any
) -> None:
    """Run a campaign on a task, and save its table and figure."""
    from sbi_active import Campaign
    from sbi_active.cli.problem import campaign_options, task_of
    from sbi_active.display.figures import save
    from sbi_active.seeding import derive_seed, forked_generators

    start, found = time.perf_counter(), task_of(task, option)
    # Campaigns of earlier runs stay as they are.
    paths = (out / f"campaign{f'-{k}' * (k > 1)}" for k in itertools.count(1))
    folder = next(path for path in paths if not path.exists())
    real = (derive_seed(seed, "real", index) for index in itertools.count())
    with Campaign(
        *(found.simulator, found.prior, found.actions),
        method=method,
        seed=seed,
        options=campaign_options(given),
        directory=folder,
        show_progress=sys.stderr.isatty(),
    ) as campaign:
        write_declared(folder, task=task, option=option)
        campaign.run(
            lambda action: found.real_system(action, seed=next(real)), num_rounds=rounds
        )
        with forked_generators(seed, "figure"):
            figure = campaign.plot(theta_true=found.theta_true)
        save(figure, str(out / "loop.png"))
        sum_up_campaign(campaign)
    campaign.to_dataframe().to_csv(out / "trials.csv")
    names = zip(found.parameter_names, found.theta_true, strict=True)
    print(answer_of(campaign).text)
    print(f"the truth: {', '.join(f'{name} = {value:g}' for name, value in names)}")
    wall = time.perf_counter() - start
    print(f"{wall:.1f} s; figure: {out / 'loop.png'}; trials: {out / 'trials.csv'}")
    print(f"to go on with it: sbi-active ask {folder}")


@cli.command(
    cli.argument("simulator", "[MODULE:FUNCTION]", cli.TEXT, required=False),
    *(cli.A_TASK, cli.OF_TASK, *cli.SPACE, cli.ROUNDS, cli.WORKERS, cli.SEED),
    cli.option("--rows", "a check", cli.COUNT, default=256),
)
def check(rows: int, rounds: int, workers: int, seed: int, **problem: Any) -> int:
    """Look a simulator over before a campaign.

    Shapes, seeds, noise, lost rows, parameters that change nothing, and the cost of a
    campaign; exit status 1 where something keeps a campaign from working.
    """
    from sbi_active import CampaignOptions
    from sbi_active.cli.problem import problem_of
    from sbi_active.simulation import check_simulator

    model, prior, actions, _ = problem_of(problem)
    # The most that the default options allow: a round trains, designs over all actions,
    # and refines on the trials so far.
    options: Any = CampaignOptions(workers=workers)  # pyright: ignore
    num_actions = len(getattr(actions, "values", range(MANY_ACTIONS)))
    most = rounds * (options.num_simulations + num_actions * options.num_samples)
    most += sum(range(1, rounds + 1)) * options.refinement.num_histories
    say("running the simulator")
    sizes: Any = {"num_rows": rows, "num_simulations": most, "workers": workers}
    report = check_simulator(model, prior, actions, **sizes, seed=seed)
    # Where simulations take longer than this, they are what a campaign takes.
    if report.is_ready and 60 * (report.minutes or 0.0) <= LONG * rounds:
        say("timing a round")
        try:
            seconds = time_round(model, prior, actions, options, seed)
            report = replace(report, seconds_round=seconds, num_rounds=rounds)
        except Exception as error:  # whatever a campaign meets is the finding
            report = replace(report, defects=(f"a round of a campaign fails: {error}",))
    print(report)
    return 0 if report.is_ready else 1


def time_round(model: Any, prior: Any, actions: Any, options: Any, seed: int) -> float:
    """Return wall seconds of a round on an outcome that the prior allows."""
    from sbi_active import Campaign, simulate
    from sbi_active.seeding import forked_generators

    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the round is thrown away
        campaign = Campaign(model, prior, actions, seed=seed, options=options)
        action = campaign.ask().action[None]
        with forked_generators(seed, "truth"):
            theta = prior.sample((1,)).float()
        campaign.tell(simulate(model, theta, action, seed=seed).x[0])
        campaign.update()
    return time.perf_counter() - start


@cli.command(
    *(cli.DIR, *cli.PROBLEM, cli.SEED, cli.WORKERS),
    cli.option("--rows", "in all, in whole thousands", cli.COUNT, required=True),
    group=bank,
)
def build(folder: Path, rows: int, seed: int, workers: int, **problem: Any) -> None:
    """Simulate into a bank, from where it ended."""
    from tqdm import tqdm

    from sbi_active import Bank, simulate
    from sbi_active.cli.problem import problem_of
    from sbi_active.seeding import derive_seed, forked_generators

    model, prior, actions, _ = problem_of(problem)
    missing = 0
    with Bank(folder, simulator=model, created=date.today().isoformat()) as made:
        store = made.drawn_from(prior, label="prior")
        for start in tqdm(range(0, rows, BLOCK), desc="bank", unit_scale=BLOCK):
            block = derive_seed(seed, "bank", start)
            with forked_generators(block, "theta"):
                theta = prior.sample((BLOCK,)).float()
            action = actions.sample((BLOCK,), seed=derive_seed(block, "action"))
            done = simulate(
                model, theta, action, seed=block, workers=workers, store=store
            )
            missing += done.counts["missing"]
    print(f"{folder}: {len(made)} rows, {made.counts}")
    if missing:
        print(f"note: {missing} rows are missing; run again to try them once more")


@cli.command(cli.DIR, group=bank)
def inspect(folder: Path) -> int:
    """Show outcomes, and compare checksums."""
    from sbi_active import Bank

    made = Bank(folder)
    if problems := made.verify():
        print("\n".join(["checksums: NOT ok", *problems]))
        return 1
    header = made.header
    shapes = (header["shapes"] or {}).items()
    model: Any = header["simulator"]
    name = model["name"] if isinstance(model, dict) and "name" in model else str(model)
    num_bytes = sum(path.stat().st_size for path in folder.glob("store.db*"))
    for line in (
        f"simulator: {shown(name)} {shown(header['version'])}".rstrip(),
        f"created: {shown(header['created'] or 'not noted')}",
        *(f"{name}: {' x '.join(map(str, shape))} a row" for name, shape in shapes),
        f"parameters: {', '.join(map(shown, header['parameter_names'] or ['?']))}",
        f"rows: {made.counts}; on disk: {num_bytes / 2**20:.2f} MiB",
        f"drawn from: {', '.join(shown(label or '?') for label in made.labels)}",
        "checksums: ok",
    ):
        print(line)
    return 0


def shown(text: str) -> str:
    """Return a text from a file so that it cannot steer the terminal."""
    return text if text.isprintable() else ascii(text)


@cli.command(cli.DIR)
def migrate(folder: Path) -> None:
    """Bring a campaign or bank of release 0.1 up to date."""
    from sbi_active.migration import migrate as migrated

    for name, number in migrated(folder).items():
        is_log = name == "log"
        print(f"log: {number} events" if is_log else f"bank {name}: {number} rows")
    print(f"the files of before are in {folder / 'version-1'}")
