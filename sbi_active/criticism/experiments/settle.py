"""Verdicts and trials by turns, until the verdict is settled."""

from __future__ import annotations

import json
import operator
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.criticism.criticism import Criticism
from sbi_active.criticism.data.arrays import without_inf
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.trial_conditions import unmeasured
from sbi_active.criticism.experiments.choice import (
    choose,
    is_settled,
    register,
    unless_unproven,
)
from sbi_active.criticism.report.contents import TestedTrial
from sbi_active.criticism.report.report import Report
from sbi_active.criticism.results import Array
from sbi_active.expected import require
from sbi_active.messages import Explained
from sbi_active.simulation import SimulatorModel


class VerdictError(Explained, RuntimeError):
    """The verdict failed after trials were run, which are kept.

    Attributes:
        code: Code of the message.
        trials: All trials, those that were run among them.
    """

    code = "SA532"

    def __init__(self, message: str, trials: Trials) -> None:
        super().__init__(message)
        self.trials = trials


def settle(
    compare: Callable[[Trials], Criticism],
    trials: Trials,
    real_system: Callable[[Tensor], Any],
    *,
    max_trials: int,
    directory: str | Path | None = None,
    evaluate: bool = True,
    tests: int = 3,
    **options: bool,
) -> Report:
    """Return the report after as many trials as settle its verdict.

    A trial is chosen so that it puts the verdict to the test most; what the verdict
    predicts of it is written down; the trial is run, kept and scored, and the same rule
    is asked for a verdict with the trial among the data. It ends if the verdict is
    settled, if no permitted action tells more, or after ``max_trials``.

    Args:
        compare: Function that compares trials with the models.
        trials: Trials so far.
        real_system: Function that takes an action, shape (action_dim,), and gives x.
        max_trials: Trials to run at most.
        directory: Folder that keeps predictions and measurements, from which a loop
            that was interrupted goes on; None keeps them in the report alone.
        evaluate: Whether the report has the error before and after.
        tests: Trials that a verdict that names effects has to predict: of the aliases
            of tuning seeds that fall by a trial some predict one, and one two.
        **options: Further options of :meth:`.Criticism.report`.

    Raises:
        ValueError: If there are no permitted actions, or the folder belongs to other
            trials.
        VerdictError: If the comparison fails after a trial was run.
    """
    first = compare(trials)
    expected = "the permitted actions with real_system"
    require(first.actions is not None, expected, None, "pass actions=")
    journal = Journal(directory)
    journal.begin(digest=first.digest, num_trials=len(trials))
    tested = journal.tested()
    for trial in tested:
        trials = with_trial(first.model, trials, trial.action, trial.x)
    scored = evaluate and bool(trials.held_out_positions)

    def verdict() -> tuple[Criticism, Report]:
        try:
            found = compare(trials) if tested else first
            report = found.report(evaluate=scored, plan=False)
        except Exception as error:
            if not tested:
                raise
            raise VerdictError(
                f"expected a verdict on {len(trials)} trials; got {error}; go on from "
                "the directory, or from .trials of this error",
                trials,
            ) from error
        return found, replace(report, tested=(*tested,))

    while True:
        criticism, report = verdict()
        is_last, chosen = len(tested) >= max_trials, None
        if not (is_last or is_settled(report, tests)):
            chosen = choose(criticism, report)
        if chosen is None:  # fewer tests settle where no action is left
            why = "no trials are left" if is_last else "no permitted action tells more"
            stopped = "settled" if is_settled(report) else why
            break
        registered = register(criticism, report, chosen, _next_index(trials))
        predicted = {k: v for k, v in vars(registered).items() if k != "x"}
        journal.write("registered", **predicted)
        action = torch.from_numpy(registered.action)
        x = np.array(torch.as_tensor(real_system(action.float())), dtype=float)
        journal.write("measured", index=registered.index, x=x)
        tested.append(replace(registered, x=x))
        trials = with_trial(first.model, trials, registered.action, x)
    report = criticism.report(evaluate=evaluate, **options)
    report = replace(report, tested=(*tested,))
    report = unless_unproven(report, criticism.rule.remaining)
    if stopped == "settled" and not is_settled(report):
        stopped = "trials that had no part in it speak against the verdict"
    verdicts = [*[trial.verdict for trial in tested[1:]], report.verdict]
    after = (*[replace(t, after=v) for t, v in zip(tested, verdicts, strict=False)],)
    return replace(report, tested=after, stopped=stopped)


def with_trial(
    model: SimulatorModel, trials: Trials, action: Array, x: Array
) -> Trials:
    """Return trials with one more, that may be fitted, behind them.

    Args:
        model: The simulator, which may know the inputs at an action.
        trials: Trials so far.
        action: Action of the new one, shape (action_dim,).
        x: Its numbers, of the shape of x of a trial.

    Raises:
        ValueError: If x has another shape than that of the trials.
    """
    template, _ = trials.template()
    expected = f"x of shape {tuple(template.shape)} from the real system"
    advice = "return the numbers of one trial, NaN for those missing"
    require(np.size(x) == template.numel(), expected, np.shape(x), advice)
    index = torch.tensor([_next_index(trials)], dtype=torch.float64)
    new = unmeasured(model, trials, torch.from_numpy(action)[None], index)
    new.x = without_inf(torch.from_numpy(x).to(new.x).reshape(new.x.shape), new.names)
    return trials.joined(new)


def _next_index(trials: Trials) -> float:
    return float(trials.index.max()) + 1


NAME = "trials.jsonl"


class Journal:
    """A file of events, one a line: begun, registered, measured.

    Args:
        directory: Folder of the file; None keeps nothing.
    """

    def __init__(self, directory: str | Path | None) -> None:
        self.path = None if directory is None else Path(directory) / NAME
        self.events = [] if self.path is None else _read(self.path)

    def write(self, event: str, **parts: Any) -> None:
        """Add an event; it is on disk when this returns.

        Args:
            event: Name of the event.
            **parts: Numbers, texts and arrays.
        """
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        said = {"event": event, **parts}
        line = json.dumps(said, default=operator.methodcaller("tolist"))
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())

    def begin(self, **about: Any) -> None:
        """Write what the trials belong to, or compare it with what stands there.

        Args:
            **about: Texts and whole numbers.

        Raises:
            ValueError: If the folder belongs to other trials or another library.
        """
        if not self.events:
            self.write("begun", **about)
            return
        own = {name: self.events[0].get(name) for name in about}
        advice = "pass what it was begun with, or another directory"
        require(own == about, f"the trials of {self.path}, {own}", about, advice)

    def tested(self) -> list[TestedTrial]:
        """Return the trials that were measured, each with its prediction."""
        trials = dict[float, dict[str, Any]]()
        for event in self.events:
            if "index" in event:
                trials.setdefault(event["index"], {}).update(event)
        return [_tested(parts) for parts in trials.values() if "x" in parts]


def _tested(parts: dict[str, Any]) -> TestedTrial:
    own = {f.name: parts[f.name] for f in fields(TestedTrial) if f.name in parts}
    own |= {k: np.asarray(v) for k, v in own.items() if isinstance(v, list)}
    own["without"] = {k: np.asarray(v) for k, v in own.get("without", {}).items()}
    return TestedTrial(**{**own, "x": np.asarray(own["x"], dtype=float)})


def _read(path: Path) -> list[dict[str, Any]]:
    """Return the events of a file; a last line that was cut off is none."""
    if not path.exists():
        return []
    whole, _, cut = path.read_text(encoding="utf-8").rpartition("\n")
    if cut:
        path.write_text(f"{whole}\n" if whole else "", encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]
