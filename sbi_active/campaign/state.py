"""The state of a campaign: plain data, from which everything else follows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active import progress
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.telling import Facts, Health, Status, facts_in
from sbi_active.design.design import Design
from sbi_active.inference.emulation.pool import Batch
from sbi_active.messages import warn
from sbi_active.seeding import draws_of
from sbi_active.simulation.workers.store import Meter

#: Ranges of the simulations from the prior beyond all of them at which an outcome is no
#: longer used: no simulator that is worth refining is that far off.
FAR = 5.0


@dataclass(frozen=True)
class Trial:
    """One trial on the real system.

    Attributes:
        index: Position in the campaign, from 0.
        action: The action asked for and, once told, the one executed, (action_dim,).
        x: The outcome, shape x_shape; None while pending or missing.
        status: "pending"; "ok"; "invalid" where the trial ran and gave no measurement,
            which is information; "missing" where a fault unrelated to the parameters
            hit it, and "withdrawn" where it was taken back, which are ignored.
        design: The design behind the action; None if the trial was not asked for.
        target: Target of the action: "theta" or names of parameters, "model", "check"
            for an action far from all others, "random"; None for an action that was not
            asked for.
        information_gained: Realized gain, KL(belief after || before), nats.
        surprise: Tail probability of x under the posterior predictive of the belief
            before the trial; uniform where the simulator is right.
        belief_error: Error in nats of the belief before the trial due to few
            simulations, by its own estimate; above 0.2 the surprise says nothing about
            the simulator.
        log_score: Log density of x under it, nats.
        misfit: Tail probability of all trials so far under the belief after this one,
            which was fitted to them; None for a belief that was not refined, or that is
            off by more than 0.2 nats.
        outlyingness: Distance of x beyond all simulations from the prior at this
            action, in their range, by its farthest number; inf if none of them had
            such a number, None if it is as others from the belief before are. Above
            5 nothing in the prior explains the trial, and the belief leaves it out.
        summary: The summary of the outcome that the belief rests on, where the action
            chooses among several.
        reason: Reason for which it was withdrawn.
        cost: Cost of the executed action, also of a trial that was missing or withdrawn
            since; None while it is pending, and without a cost or a budget.
        health: Health of the campaign when the trial had been used; None before.
        version: Number of the model that scored the trial.
        seconds: Wall time by stage; it and what follows add up if computed again.
        cpu_seconds: CPU time by stage.
        num_simulations: Simulations spent on this trial.
        num_missing: Number of those simulations lost to faults of the simulator.
    """

    index: int
    action: Tensor
    x: Tensor | None = None
    status: Status = "pending"
    design: Design | None = None
    target: str | None = None
    information_gained: float | None = None
    surprise: float | None = None
    belief_error: float | None = None
    log_score: float | None = None
    misfit: float | None = None
    outlyingness: float | None = None
    summary: str | None = None
    reason: str = ""
    cost: float | None = None
    health: Health | None = None
    version: int | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    num_simulations: int = 0
    num_missing: int = 0

    def __repr__(self) -> str:
        outcome = "" if self.x is None else f", x [{first_numbers(self.x)}]"
        gain = self.information_gained
        told = "" if gain is None else f", {gain:.2f} nats"
        action = first_numbers(self.action)
        return f"Trial({self.index}: action [{action}], {self.status}{outcome}{told})"

    @property
    def expected_gain(self) -> tuple[float, float]:
        """Its expected gain and the standard error, nats; NaN if not designed."""
        design = self.design
        if design is None:
            return float("nan"), float("nan")
        gain, error = design.expected_information_gain, design.standard_error
        return float(gain[design.index]), float(error[design.index])

    @cached_property  # not a property: trials that were stored have it as a field
    def network_used_by(self) -> tuple[str, ...]:
        """Former users of this round's network, no longer written down."""
        warn("SA701 Trial.network_used_by goes in the next version")
        return ()

    @property
    def is_measured(self) -> bool:
        """Whether it ran and tells about the parameters, by a measurement or none."""
        return self.status in ("ok", "invalid")

    @property
    def is_explained(self) -> bool:
        """Whether it is measured and something in the prior may explain it."""
        return self.is_measured and (self.outlyingness or 0.0) <= FAR


@dataclass(frozen=True)
class ModelVersion:
    """A simulator that a campaign used, and how it came to it.

    Attributes:
        number: Number of the version; 0 is the simulator that the campaign began with.
        effects: Effects that were adopted so far, in the order of their parameters.
        digest: Hash of noise, library and priors behind the adoption; "" at first.
        num_trials: Number of trials told before it was adopted.
        misfit: Misfit of the trials that the version was given, as in :class:`Trial`.
        examined: Digests of the comparisons of this version with trials, in order.
        trials: Indices of those told before it was adopted, which it was given at once.
    """

    number: int = 0
    effects: tuple[str, ...] = ()
    digest: str = ""
    num_trials: int = 0
    misfit: float | None = None
    examined: tuple[str, ...] = ()
    trials: tuple[int, ...] = ()


#: Fields of a trial that was not scored.
UNSCORED: dict[str, Any] = dict.fromkeys(
    ("information_gained", "surprise", "belief_error", "log_score", "misfit")
    + ("outlyingness", "health", "version")
)


def tensor_of(listed: Any) -> Tensor:
    """Return the numbers of :class:`.Facts`, whose None are NaN."""
    with torch.inference_mode(False):  # they are trained on later
        return torch.from_numpy(np.array(listed, np.float64)).float()


def first_numbers(values: Tensor | None, most: int = 6) -> str:
    """Return the first numbers of an action or an outcome."""
    numbers = [] if values is None else [f"{v:.4g}" for v in values.flatten().tolist()]
    left = len(numbers) - most
    shown = ", ".join(numbers[:most])
    return f"{shown} and {left} more" if left > 0 else shown


@dataclass
class CampaignState:
    """All that a campaign is: with the simulator, the rest can be computed again.

    Attributes:
        method: Name of the method.
        seed: Seed of all draws.
        options: Sizes and estimators.
        trials: Trials in the order in which they were asked for or told.
        processed: Indices of trials that the belief contains, in order of use.
        versions: Lineage of the simulator, the current one last.
        is_stale: Whether a trial that the belief contains was corrected since.
        draws: Draws of the belief after each trial, for pictures, by the trial's index,
            shape (n, theta_dim); of the parameters that the model had then.
        batches: Simulations for the current model where all that asks shares them.
        meter: Counter of the campaign's simulations.
        show_progress: Whether to draw a bar of what takes long.
    """

    method: str
    seed: int
    options: CampaignOptions
    trials: list[Trial] = field(default_factory=list)
    processed: list[int] = field(default_factory=list)
    versions: list[ModelVersion] = field(default_factory=lambda: [ModelVersion()])
    is_stale: bool = False
    draws: dict[int, Tensor] = field(default_factory=dict)
    batches: list[Batch] = field(default_factory=list)
    meter: Meter = field(default_factory=Meter)
    show_progress: bool = field(default=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.meter.limit = self.options.max_simulations

    @property
    def version(self) -> ModelVersion:
        """The current model."""
        return self.versions[-1]

    @property
    def measured(self) -> Sequence[Trial]:
        """The trials so far that tell about the parameters, in the order of use."""
        return [t for i in self.processed if (t := self.trials[i]).is_measured]

    @property
    def explained(self) -> Sequence[Trial]:
        """The trials that the belief rests on, in the order of use."""
        return [t for t in self.measured if t.is_explained]

    def record(self, facts: Facts) -> Trial:
        """Keep a trial as the log has it, and note where that changes what was used.

        Earlier findings stay if the trial tells the same as before.
        """
        index, num = facts.index, len(self.trials)
        action = tensor_of(facts.action)
        if index > num:
            raise ValueError(f"expected a trial after {num}; got {index}")
        x = None if facts.x is None else tensor_of(facts.x)
        known: dict[str, Any] = {**vars(facts), "action": action, "x": x}
        if index == num:
            self.trials.append(Trial(**known))
        else:
            before = self.trials[index]
            same = before.status == "pending" or Facts.of(before).tells == facts.tells
            known |= {} if same else UNSCORED
            self.trials[index] = replace(before, **known)
            for later in self.trials[index:]:  # which may cost by the trial before
                if later.cost is not None:
                    self.change(later.index, cost=None)
        self.is_stale |= index in self.processed
        return self.trials[index]

    def apply(self, event: Mapping[str, Any]) -> None:
        """Change by a line of the log, as the campaign did when it was written."""
        what, facts = event["event"], facts_in(event)
        if facts is not None:
            self.record(facts)
        elif what == "simulator changed":
            self.is_stale = bool(self.processed)  # until an update is saved
        elif what == "examined":
            self.examined(event["digest"])
        elif what == "adopted":
            version: dict[str, Any] = {
                name: tuple(part) if isinstance(part, list) else part
                for name, part in event["version"].items()
            }
            self.versions.append(ModelVersion(**version))
            self.processed[:] = version["trials"]
            self.is_stale = True

    def examined(self, digest: str) -> None:
        """Note that the current model was compared with the trials.

        Args:
            digest: Digest of the comparison.
        """
        examined = (*self.version.examined, digest)
        self.versions[-1] = replace(self.version, examined=examined)

    def change(self, index: int, **changes: Any) -> None:
        """Replace entries of a trial."""
        self.trials[index] = replace(self.trials[index], **changes)

    def account(
        self, index: int, num_simulations: int, num_missing: int, **changes: Any
    ) -> None:
        """Add simulations to a trial's account, and replace entries of it."""
        if index == len(self.trials):  # ahead of a trial, on no account
            return
        trial = self.trials[index]
        self.change(
            index,
            num_simulations=trial.num_simulations + num_simulations,
            num_missing=trial.num_missing + num_missing,
            **changes,
        )

    def keep_draws(self, belief: Distribution, num: int = 256) -> None:
        """Keep draws of the belief after the last trial in it, to show it later.

        Nothing is computed from them, and no other random number depends on them.

        Args:
            belief: Belief after ``processed``.
            num: Number of draws; 256 give a standard deviation to 4 %, in 3 kB a trial
                of 3 parameters.
        """
        if not self.processed:
            return
        index = self.processed[-1]
        draws = draws_of(belief, num, self.seed, "draws", index)
        self.draws[index] = draws.reshape(num, -1).detach()

    @property
    def spent(self) -> float | None:
        """Total cost of the trials that were told; None if it is not known."""
        costs = [t.cost for t in self.trials if t.status != "pending"]
        return None if None in costs else sum(filter(None, costs))

    @property
    def left(self) -> float | None:
        """What is left of the budget; None without one, or if it is not known."""
        spent, budget = self.spent, self.options.stop.budget
        return None if spent is None or budget is None else budget - spent

    @property
    def used_up(self) -> str | None:
        """Why no round can begin, where the campaign's simulations are used up."""
        meter, fewest = self.meter, 24
        if meter.left >= fewest:
            return None
        return (
            f"the simulations are used up: {meter.spent} of max_simulations = "
            f"{meter.limit} were run, and a round needs {fewest} or more; the last "
            "belief stands"
        )

    def watched(self, index: int, name: str) -> AbstractContextManager[None]:
        """Show progress while the block runs.

        Args:
            index: Index of the trial that the work is for, or of the next one.
            name: Name of the work.
        """
        what = f"trial {index}: {name}" if index < len(self.trials) else name
        return progress.stage(what, show_progress=self.show_progress)

    @contextmanager
    def stage(self, index: int, name: str) -> Iterator[None]:
        """Add the time spent in the block to a trial's account, less stages within.

        Work before a trial is asked for is not added to any account.
        """
        with self.watched(index, name):
            if index == len(self.trials):
                yield
            else:
                yield from self._timed(index, name)

    def _timed(self, index: int, name: str) -> Iterator[None]:
        before = self.trials[index]
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        trial = self.trials[index]
        wall -= sum(trial.seconds.values()) - sum(before.seconds.values())
        cpu -= sum(trial.cpu_seconds.values()) - sum(before.cpu_seconds.values())
        seconds, cpu_seconds = dict(trial.seconds), dict(trial.cpu_seconds)
        seconds[name] = seconds.get(name, 0.0) + wall
        cpu_seconds[name] = cpu_seconds.get(name, 0.0) + cpu
        self.change(index, seconds=seconds, cpu_seconds=cpu_seconds)
