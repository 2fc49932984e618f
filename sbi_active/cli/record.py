"""A campaign and its trials as JSON, and as lines for people; told without torch.

A command that has computed leaves a summary. What was told since is read from the log,
and :class:`Record` is all that ``tell``, ``correct``, ``withdraw`` and ``status`` need.
What it cannot judge alone is :class:`Unsure`, and the campaign is loaded.
"""

from __future__ import annotations

import contextlib
import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sbi_active.campaign.telling import (
    LOG,
    STATE,
    SUMMARY,
    Facts,
    Telling,
    event_of,
    facts_in,
    flat,
)
from sbi_active.cli.output import Answer
from sbi_active.simulation.bank.store import Store


class Unsure(Exception):  # noqa: N818
    """Only the campaign itself can judge what is told."""


def digest(folder: Path) -> str:
    """Return a text that changes whenever anybody writes to a campaign.

    Args:
        folder: Folder of the campaign.
    """
    with contextlib.suppress(OSError, ValueError), _stored(folder) as store:
        return store.seal(LOG, STATE)
    return ""


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
            with _stored(folder) as store:
                self._known = json.loads(store.get(SUMMARY) or b"{}")
                self._kept: list[Any] = [
                    SimpleNamespace(**trial) for trial in self._known["trials"]
                ]
                self.actions = SimpleNamespace(**self._known["actions"])
                self._num: int = self._known["lines"]
                for number in range(self._num + 1, store.length(LOG) + 1):
                    self._take(store.json(LOG, number) or {})
        except (OSError, ValueError, RecursionError, LookupError, TypeError) as error:
            raise Unsure from error

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of what was computed.

        Raises:
            Unsure: If a trial that the belief has used is another one now.
        """
        if {*self._known["summary"]["not_in_belief"]} & {*self._known["processed"]}:
            raise Unsure
        return self._known["summary"]

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
        line = event_of(event, facts)
        with _stored(self.directory) as store, store.writing():
            is_known = store.length(LOG) == self._num  # else another process was faster
            if is_known:
                store.append(LOG, line)
        if not is_known:
            raise Unsure
        self._take(line)
        return self._kept[facts.index]

    def _take(self, entry: Mapping[str, Any]) -> None:
        """Take a line of the log that was written after the summary."""
        self._num += 1
        if entry["event"] == "refused":
            return
        facts, summary = facts_in(entry), self._known["summary"]
        if facts is None or facts.index > len(self._kept):
            raise Unsure
        self._kept[facts.index : facts.index + 1] = [facts]
        told = [facts.index] * (facts.status != "pending")
        summary["not_in_belief"] = sorted({*summary["not_in_belief"], *told})


def _stored(folder: Path) -> contextlib.closing[Store]:
    return contextlib.closing(Store(folder, "campaign"))


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
        limits = [actions.low.tolist(), actions.high.tolist()] if is_box else [[], []]
        labels = {"names": [*actions.names], "units": [*actions.units]}
        known = {
            "summary": summary_of(campaign),
            "trials": [scored(trial) for trial in campaign.state.trials],
            "x_shape": [*campaign.x_shape],
            "actions": {**labels, "limits": [*zip(*limits, strict=True)]},
            "processed": [*campaign.state.processed],
        }
        campaign._storage.sum_up(known)


def summary_of(campaign: Any) -> dict[str, Any]:
    """Return the belief and the health of a campaign as JSON."""
    if isinstance(campaign, Record):
        return campaign.summary
    belief = campaign.belief
    mean, variance = belief.mean.reshape(-1), belief.variance.reshape(-1)
    names = campaign.parameter_names or [f"theta_{k + 1}" for k in range(len(mean))]
    diagnostics = getattr(belief, "diagnostics", None)
    said = [*getattr(diagnostics, "warnings", ())]
    together = getattr(diagnostics, "combinations", None)
    return {
        "method": campaign.state.method,
        "belief": {
            "parameters": {
                name: {"mean": float(m), "sd": float(v) ** 0.5}
                for name, m, v in zip(names, mean, variance, strict=True)
            },
            "trustworthy": getattr(diagnostics, "trustworthy", None),
            "warnings": said,
            "codes": [warning.code for warning in said],
            "combinations": str(together) if together else None,
        },
        "health": campaign.health,
        "not_in_belief": campaign.not_in_belief,
    }


def scored(trial: Any) -> dict[str, Any]:
    """Return a trial with what a campaign has found it to be, if it has yet."""
    scores = ("information_gained", "surprise")
    return {**vars(Facts.of(trial)), **{n: getattr(trial, n, None) for n in scores}}


def trial_of(campaign: Any, trial: Any) -> dict[str, Any]:
    """Return a trial as JSON, but for NaN."""
    entries = scored(trial)
    x = entries.pop("x")
    return {
        "trial": entries.pop("index"),
        **entries,
        "action": _floats(entries["action"]),
        "x": None if x is None else _floats(x),
        "names": [*campaign.actions.names],
        "units": [*campaign.actions.units],
    }


def _floats(listed: Any) -> list[float]:
    return [math.nan if value is None else value for value in flat(listed)]


def answer_of(campaign: Any) -> Answer:
    """Return the trials, the belief and the health of a campaign or a record."""
    trials = [trial_of(campaign, trial) for trial in campaign._trials]
    data = {**summary_of(campaign), "trials": trials}
    belief = data["belief"]
    pending = sum(trial["status"] == "pending" for trial in trials)
    head = f"{data['method']}, {len(trials) - pending} trials"
    head += f"{', one pending' if pending else ''}, health {data['health']}"
    lines = ["; ".join(filter(None, [head, belief["combinations"]]))]
    for trial in trials:
        gained, reason = trial["information_gained"], trial["reason"]
        gain = "" if gained is None else f"  {gained:.2f} nats"
        why = f"  ({reason})" if reason else ""
        shown = f"{place_of(trial)}{numbers_of(trial, '  x = ')}{gain}{why}"
        lines.append(f"{trial['trial']:>4}  {trial['status']:<9} {shown}")
    for name, entry in belief["parameters"].items():
        lines.append(f"{name:>12} = {entry['mean']:.4g} +- {entry['sd']:.2g}")
    lines += [f"note: {w}" for w in belief["warnings"]]
    if waiting := data["not_in_belief"]:
        lines.append(f"not in the belief yet: {waiting}; run sbi-active update")
    return Answer(data, "\n".join(lines))


def place_of(trial: Mapping[str, Any]) -> str:
    """Return a trial's action with names and units."""
    parts = zip(trial["names"], trial["action"], trial["units"], strict=True)
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def numbers_of(trial: Mapping[str, Any], before: str) -> str:
    """Return the first numbers of a trial's outcome, nothing where there is none."""
    x: Sequence[float] | None = trial["x"]
    if x is None:
        return ""
    return f"{before}{', '.join(f'{v:.4g}' for v in x[:4])}{', ...' * (len(x) > 4)}"
