"""A campaign and its trials as JSON, and as lines for people; told without torch.

A command that has computed leaves a summary. What was told since is read from the log,
and :class:`Record` is all that ``tell``, ``correct``, ``withdraw`` and ``status`` need.
What it cannot judge alone is :class:`Unsure`, and the campaign is loaded.
"""

from __future__ import annotations

import contextlib
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from types import SimpleNamespace
from typing import Any

from sbi_active.campaign import telling
from sbi_active.campaign.telling import Facts, Telling, flat
from sbi_active.cli.declare import Answer
from sbi_active.plain import with_error
from sbi_active.simulation.bank.store import Store


class Unsure(Exception):  # noqa: N818
    """Only the campaign itself can judge what is told."""


def digest(folder: Path) -> str:
    """Return a text that changes whenever anybody writes to a campaign.

    Args:
        folder: Folder of the campaign.
    """
    return Store(folder, "campaign").seal("-wal")


class Record(Telling[Any]):
    """A campaign's record, known without computing: a part of its interface.

    Args:
        folder: Folder of the campaign.

    Attributes:
        directory: Folder of the campaign.
        actions: Names, units and limits of the actions.

    Raises:
        Unsure: If there is no summary, or more was done since than told.
    """

    def __init__(self, folder: Path) -> None:
        self.directory = folder
        try:
            store = Store(folder, "campaign")
            self._known = json.loads(store.get(telling.SUMMARY) or b"{}")
            self._kept: Any = [SimpleNamespace(**t) for t in self._known["trials"]]
            self.actions = SimpleNamespace(**self._known["actions"])
            self._num: int = self._known["lines"]
            for number in range(self._num + 1, store.catalog.get(telling.LOG, 0) + 1):
                self._take(store.json(telling.LOG, number) or {})
        except (OSError, ValueError, RecursionError, LookupError, TypeError) as error:
            raise Unsure from error

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of what was computed.

        Raises:
            Unsure: If a trial that the belief has used is another one now.
        """
        summary, was_written = self._known["summary"], self._num > self._known["lines"]
        if {*summary["not_in_belief"]} & {*self._known["processed"]}:
            raise Unsure
        if was_written and (summary.get("spent") or summary.get("left")):
            raise Unsure  # what a trial costs is a function's word
        return summary

    @property
    def x_shape(self) -> Sequence[int]:
        """Shape of an outcome."""
        return self._known["x_shape"]

    @property
    def _trials(self) -> Sequence[Any]:
        return self._kept

    def _outcome(self, x: Any) -> Any:
        return _single(x)

    def _executed(self, action: Any, asked: list[float]) -> list[float]:
        if action is None:
            return asked
        executed, limits = _single(action), self.actions.limits
        pairs = zip(limits, executed, strict=False)
        is_within = all(low <= a <= high for (low, high), a in pairs)
        if len(limits) != len(executed) or not is_within:
            raise Unsure
        return executed

    def _refused(self, x: Any, error: ValueError) -> None:
        raise Unsure from error

    def _record(self, event: str, facts: Facts) -> Any:
        line = telling.event_of(event, facts)
        store = Store(self.directory, "campaign")
        with contextlib.closing(store), store.writing(telling.LOG, self._num):
            store.append(telling.LOG, line)
        self._take(line)
        return self._kept[facts.index]

    def _take(self, entry: Mapping[str, Any]) -> None:
        """Take a line of the log that was written after the summary."""
        self._num += 1
        if entry["event"] == "refused":
            return
        facts, summary = telling.facts_in(entry), self._known["summary"]
        if facts is None or facts.index > len(self._kept):
            raise Unsure
        self._kept[facts.index : facts.index + 1] = [facts]
        told = [facts.index] * (facts.status != "pending")
        summary["not_in_belief"] = sorted({*summary["not_in_belief"], *told})


def _single(x: Any) -> Any:
    """Return numbers as float32 has them, None for one not measured."""
    if isinstance(x, list):
        return [_single(part) for part in x]
    return None if x is None or x != x else struct.unpack("f", struct.pack("f", x))[0]


def sum_up_campaign(campaign: Any) -> None:
    """Leave a summary in the folder of a campaign that holds the right to write."""
    actions = campaign.actions
    with contextlib.suppress(Exception):  # a belief without moments has no summary
        is_box = type(actions).__name__ == "BoxActions"
        ends = (actions.low.tolist(), actions.high.tolist()) if is_box else ([], [])
        own = {"names": [*actions.names], "units": [*actions.units]}
        known = {
            "summary": summary_of(campaign),
            "trials": [scored(trial) for trial in campaign.state.trials],
            "x_shape": [*campaign.x_shape],
            "actions": {**own, "limits": [*zip(*ends, strict=True)]},
            "processed": [*campaign.state.processed],
        }
        campaign._storage.sum_up(known)


def summary_of(campaign: Any) -> dict[str, Any]:
    """Return the belief and the health of a campaign as JSON."""
    if isinstance(campaign, Record):
        return campaign.summary
    belief = campaign.belief
    mean, sd = belief.mean.flatten().tolist(), belief.variance.flatten().tolist()
    moments = [{"mean": m, "sd": v**0.5} for m, v in zip(mean, sd, strict=True)]
    diagnostics = getattr(belief, "diagnostics", None)
    said = [*getattr(diagnostics, "warnings", ())]
    together = getattr(diagnostics, "combinations", None)
    found = {
        "parameters": dict(zip(campaign.parameter_names, moments, strict=True)),
        "trustworthy": getattr(diagnostics, "trustworthy", None),
        "warnings": said,
        "codes": [warning.code for warning in said],
        "combinations": str(together) if together else None,
    }
    state = campaign.state
    now = {"health": campaign.health, "not_in_belief": campaign.not_in_belief}
    now |= {"spent": state.spent, "left": state.left}
    return {"method": state.method, "belief": found, **now}


def scored(trial: Any) -> dict[str, Any]:
    """Return a trial with what a campaign has found it to be, if it has yet."""
    scores = ("information_gained", "surprise", "cost")
    return {**vars(Facts.of(trial)), **{n: getattr(trial, n, None) for n in scores}}


def trial_of(campaign: Any, trial: Any) -> dict[str, Any]:
    """Return a trial as JSON, null for a number that was not measured."""
    found = scored(trial)
    found = {"trial": found.pop("index"), **found}
    for name in ("action", "x"):
        found[name] = None if found[name] is None else flat(found[name])
    actions = campaign.actions
    return {**found, "names": [*actions.names], "units": [*actions.units]}


def answer_of(campaign: Any) -> Answer:
    """Return the trials, the belief and the health of a campaign or a record."""
    trials = [trial_of(campaign, trial) for trial in campaign._trials]
    data = {**summary_of(campaign), "trials": trials}
    belief, waiting = data["belief"], data["not_in_belief"]
    many = "s" * (len(trials) != 1)
    lines = [f"{data['method']}, {len(trials)} trial{many}, health {data['health']}"]
    lines += map(_line_of, trials)
    if data.get("spent") or data.get("left"):
        left = "" if data["left"] is None else f", {data['left']:.4g} left"
        lines.append(f"{data['spent']:.4g} spent{left}")
    for name, entry in belief["parameters"].items():
        lines.append(f"{name:>12} = {with_error(entry['mean'], entry['sd'])}")
    notes = [belief["combinations"], *belief["warnings"]]
    lines += [f"note: {said}" for said in notes if said]
    if waiting:
        lines.append(f"not in the belief yet: {waiting}; run sbi-active update")
    return Answer(data, "\n".join(lines))


def confirmed(campaign: Any, trial: Any) -> Answer:
    """Return a trial that was told."""
    data = trial_of(campaign, trial)
    then = f"next: sbi-active ask {quote(str(campaign.directory))}"
    return Answer(data, f"{_line_of(data)}\n{then}")


def place_of(trial: Mapping[str, Any]) -> str:
    """Return a trial's action with names and units."""
    parts = zip(trial["names"], trial["action"], trial["units"], strict=True)
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def _line_of(trial: Mapping[str, Any]) -> str:
    x, reason = trial["x"] or [], trial["reason"]
    shown = ["nan" if value is None else f"{value:.4g}" for value in x[:4]]
    numbers = ", ".join(shown) + ", ..." * (len(x) > 4)
    line = f"{trial['trial']:>4}  {trial['status']:<9} {place_of(trial)}"
    return line + f"  x = {numbers}" * bool(x) + f"  ({reason})" * bool(reason)
