"""Commands on simulators: run, check and criticize one; and bring files up to date."""

from __future__ import annotations

import inspect
import itertools
import sys
from pathlib import Path
from typing import Any

from sbi_active.cli import declare as cli
from sbi_active.cli.campaign import Session
from sbi_active.cli.record import answer_of, sum_up_campaign
from sbi_active.expected import require

#: Arguments and options that say what is compared with what.
CRITICIZE = [
    cli.argument("trials", "TRIALS.csv", cli.FILE),
    *(cli.SIMULATOR, cli.TASK, cli.OF_TASK, *cli.SPACE, cli.SEED, cli.JSON),
    cli.repeated("--columns", "as x=height_m", "KEY=NAME[,NAME...]"),
    cli.option("--inputs", "at times of their own", cli.FILE, "INPUTS.csv"),
    cli.repeated("--set", "of close_loop, as warm_up=0.5", "NAME=VALUE"),
    cli.option("--out", "folder for the report", cli.FOLDER, "DIR"),
]


@cli.command(*CRITICIZE)
def criticize(trials: Path, **given: Any) -> cli.Answer:
    """Find what a simulator lacks, from measured trials.

    Find the residual, trace it to an effect that the simulator lacks, add it, and
    report the error before and after.

    TRIALS.csv has one row a trial, with columns action_* and x_* and optionally role
    (fit or 'held out'), index and repeat_of; or one row a sample, with columns trial
    and time besides, and with input_* in place of actions that vary in time. start_* is
    a measured start state. Units stand in brackets, as in x_height[m], and become SI.
    An empty cell is what was not measured. In its place a folder: of a campaign, which
    knows its simulator and its prior, or of recordings, with trials.csv or one file
    *.csv a trial.
    """
    if given["out"] is not None:  # else all is computed before this fails
        given["out"].mkdir(parents=True, exist_ok=True)
    if not any((trials / name).exists() for name in ("store.db", "campaign.json")):
        return _compared(trials, given)
    own = (*("task", "theta_low", "theta_high", "actions"), "columns", "inputs", "set")
    wrong = ", ".join(name for name in own if given[name])
    what = "--simulator, --noise or --out for a campaign, which has its own problem"
    require(not wrong, what, wrong, "leave it out")
    session = Session(trials, given["simulator"], given["noise"])
    return session.call(_criticized, "simulator", out=given["out"])


@cli.command(*CRITICIZE)
def gate(**given: Any) -> cli.Answer:
    """Say whether a simulator may be used, as criticize finds it from the same trials.

    The exit status is 0 for SHIP, 10 for NO_IMPROVEMENT, 11 for NOT_IDENTIFIABLE, 12
    for OUT_OF_PRIOR, 13 for WRONG_MODEL and 14 for NOT_ENOUGH_DATA.
    """
    found = criticize.callback(**given).data["gate"]
    text = f"{found['decision']}: {found['reason']}"
    return cli.Answer(found, text, found["exit_code"])


def _criticized(campaign: Any, out: Path | None) -> cli.Answer:
    from sbi_active.cli.problem import library_of

    then = f"\n\nto go on with what it names: sbi-active adopt {campaign.directory}"
    return _answer(campaign.criticize(library_of(campaign)), out, then)


def _answer(report: Any, out: Path | None, then: str = "") -> cli.Answer:
    saved = "" if out is None else f"\n\nsaved: {report.save(out)}"
    return cli.Answer(report.to_dict(), f"{report}{saved}{then}")


def _compared(path: Path, given: dict[str, Any]) -> cli.Answer:
    """Compare a simulator with the trials of a table, or of a folder of recordings."""
    from sbi_active import DiscreteActions, SimulatorModel
    from sbi_active.cli.problem import problem_of, with_generic, with_noise
    from sbi_active.criticism import Trials, close_loop

    how, columns = cli.pairs_of(given["set"]), cli.pairs_of(given["columns"])
    with cli.misuse("settings of close_loop"):
        inspect.signature(close_loop).bind_partial(**how)
    noise = given.pop("noise")
    model, prior, actions, effects = problem_of(given, needs=["prior"])
    named = {key: str(names).split(",") for key, names in columns.items()}
    trials = Trials.from_csv(path, columns=named or None, inputs=given["inputs"])
    if not isinstance(model, SimulatorModel):
        model = SimulatorModel(model, sample_times=trials.template()[1])
    model = with_noise(model, noise)
    # Only scales are taken from these where the permitted actions are unknown.
    space = actions or DiscreteActions(trials.action.unique(dim=0).float())
    known = space if trials.inputs is None else trials
    how = {"show_progress": sys.stderr.isatty(), "seed": given["seed"], **how}
    how |= {"effects": with_generic(effects, model, known, prior), "actions": actions}
    return _answer(close_loop(model, prior, trials, **how), given["out"])


@cli.command(
    cli.argument("task", "TASK", str),
    *(cli.METHOD, cli.SEED, cli.OF_TASK, cli.SETTINGS, cli.JSON),
    cli.option("--rounds", "real trials", cli.COUNT, default=4),
    cli.option("--out", "folder for the results", cli.FOLDER, "DIR", required=True),
)
def run(task: str, out: Path, method: str, seed: int, **given: Any) -> cli.Answer:
    """Run a campaign on a task, and save its table and figure."""
    from sbi_active import Campaign
    from sbi_active.cli.problem import campaign_options, remember, task_of
    from sbi_active.display.figures import save
    from sbi_active.seeding import derive_seed, forked_generators

    found = task_of(task, given["option"])
    # Campaigns of earlier runs stay as they are.
    paths = (out / f"campaign{f'-{k}' * (k > 1)}" for k in itertools.count(1))
    folder = next(path for path in paths if not path.exists())
    real = (derive_seed(seed, "real", index) for index in itertools.count())
    how: Any = {"options": campaign_options(given["set"]), "method": method}
    how |= {"seed": seed, "show_progress": sys.stderr.isatty(), "directory": folder}
    with Campaign(found.simulator, found.prior, found.actions, **how) as campaign:
        remember(folder, task=task, option=given["option"])

        def execute(action: Any) -> Any:
            return found.real_system(action, seed=next(real))

        campaign.run(execute, num_rounds=given["rounds"])
        with forked_generators(seed, "figure"):
            figure = campaign.plot(theta_true=found.theta_true)
        save(figure, str(out / "loop.png"))
        sum_up_campaign(campaign)
    campaign.to_dataframe().to_csv(out / "trials.csv")
    data, text, _ = answer_of(campaign)
    truth = dict(zip(found.parameter_names, found.theta_true.tolist(), strict=True))
    lines = [text, f"the truth: {', '.join(f'{k} = {v:g}' for k, v in truth.items())}"]
    lines += [f"saved: {out / 'loop.png'}, trials.csv; next: sbi-active ask {folder}"]
    return cli.Answer({**data, "truth": truth}, "\n".join(lines))


@cli.command(
    *(cli.argument("simulator", "MODULE:FUNCTION", str), *cli.SPACE, cli.SEED),
    *(cli.option("--rows", "a check", cli.COUNT, default=256), cli.JSON),
)
def check(rows: int, seed: int, **problem: Any) -> cli.Answer:
    """Look a simulator over before a campaign.

    Shapes, seeds, noise, lost rows, time, and parameters that change nothing; exit
    status 1 where something keeps a campaign from working.
    """
    from sbi_active.cli.problem import problem_of
    from sbi_active.simulation import check_simulator

    *found, _ = problem_of(problem)
    report = check_simulator(*found, num_rows=rows, seed=seed)
    return cli.Answer({"report": f"{report}"}, f"{report}", int(not report.is_ready))


@cli.command(cli.DIR, cli.JSON)
def migrate(folder: Path) -> cli.Answer:
    """Bring a campaign or bank of release 0.1 up to date."""
    from sbi_active.migration import migrate as migrated

    counts = migrated(folder)
    lines = [f"{name}: {number}" for name, number in counts.items()]
    lines += [f"the files of before are in {folder / 'version-1'}"]
    return cli.Answer(counts, "\n".join(lines))
