"""Simulations of candidate actions, with what is known of their noise."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.outcomes import LinearSummaries, join_outcomes
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.simulation import (
    MissingRowsWarning,
    Outcome,
    Simulations,
    SimulatorModel,
    simulate,
)
from sbi_active.simulation.noise.whitening import is_known_gaussian
from sbi_active.simulation.simulator import require_noise
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


class CandidateSampler:
    """Draw parameters from the belief and simulate candidates at them.

    Args:
        simulator: ``simulator(theta, action)``.
        belief: Distribution of the parameters.
        action: Candidates, shape (a, action_dim).
        seed: Seed of all draws.
        workers: Workers that run the simulations.
        others: Actions whose outcomes will be known as well, shape (p, action_dim);
            every draw then holds joint outcomes
            (:func:`.join_outcomes`). None for none.
        most_numbers: Number of an outcome's numbers beyond which
            :class:`.LinearSummaries` stand for them, where noise is declared that
            allows for it; infinite keeps all.

    Attributes:
        action: Candidates, to which more may be added between draws.
        declared: Whether the simulator declares its noise around an output that does
            not change from run to run.
        num_drawn: Simulations so far.
        num_missing: Number of those simulations lost to faults of the simulator.
        summaries: Summaries that stand for the numbers of an outcome; None keeps all.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        belief: Distribution,
        action: Tensor,
        seed: int,
        workers: Workers = IN_PROCESS,
        others: Tensor | None = None,
        *,
        most_numbers: float = float("inf"),
    ) -> None:
        self.simulator, self.belief = simulator, belief
        self.action, self.seed = action, seed
        self.others = action[:0] if others is None else others
        self.workers = workers
        self.num_drawn = self.num_missing = 0
        self._num_waves = 0
        self.declared = self._probe()
        self.summaries: LinearSummaries | None = None
        noise = getattr(simulator, "noise", None)
        many = self.declared and self._num_numbers > most_numbers
        if many and noise is not None and is_known_gaussian(noise):
            self.summaries = LinearSummaries(noise)

    def draw(
        self, num_samples: int, candidates: Tensor, *, replicates: bool
    ) -> CandidateSimulations:
        """Simulate candidates (k,) at fresh parameters, the same for all.

        With replicates half of the simulations repeat the parameters of the others,
        unless the noise is declared.
        """
        self._num_waves += 1
        paired = replicates and not self.declared
        num = num_samples // 2 if paired else num_samples
        with forked_generators(self.seed, "theta", self._num_waves):
            theta = self.belief.sample((num,))
        drawn = self._draw(theta, self.action[candidates], paired, "")
        if drawn is not None and len(self.others):
            beside = self._draw(theta, self.others, paired, "others")
            drawn = None if beside is None else join_outcomes(drawn, beside)
        if drawn is None:  # what is declared as noise-free is not
            self.declared = False
            return self.draw(num_samples, candidates, replicates=replicates)
        return drawn

    @property
    def notes(self) -> list[str]:
        """Notes on the summaries that stand for an outcome."""
        if self.summaries is None:
            return []
        return [self.summaries.note(self._num_numbers)]

    def rewind(self) -> None:
        """Repeat the parameters and the noise of the first draw in the next."""
        self._num_waves = 0

    def _draw(
        self, theta: Tensor, action: Tensor, paired: bool, label: str
    ) -> CandidateSimulations | None:
        """Simulate actions (a, action_dim) at parameters (n, theta_dim).

        Twice where paired; None if the declared mean turns out to change from run to
        run. The label is the seeds': outcomes that are joined have noise of their own.
        """
        num = len(theta)

        def run(
            simulator: Callable[..., Any], action: Tensor, key: str
        ) -> tuple[Tensor, Tensor]:
            seed = derive_seed(self.seed, label + key, self._num_waves)
            drawn = self._simulate(simulator, _rows(theta, action), seed)
            self.num_drawn += len(drawn)
            self.num_missing += drawn.counts["missing"]
            shape = (len(action), num)
            x = drawn.x.reshape(*shape, *drawn.x.shape[1:])
            return x, (drawn.status == Outcome.MISSING).reshape(shape)

        if self.declared:
            assert isinstance(self.simulator, SimulatorModel)
            noise, short = self.simulator.noise, self.summaries
            assert noise is not None
            means, lost = [], []
            # Many numbers are kept in memory for one action at a time.
            for some in action.split(len(action) if short is None else 1):
                mean, missing = run(self.simulator.mean, some, "x")
                rows = _rows(theta, some)
                outcomes = mean.flatten(0, 1)
                if self._num_waves == 1 and self._lost_by_luck(rows, outcomes):
                    return None
                if short is not None:
                    mean, noise = short(some[0], mean[0])[None], short.noise
                means.append(mean)
                lost.append(missing)
            mean, missing = torch.cat(means), torch.cat(lost)
            noise_seed = derive_seed(self.seed, label + "noise", self._num_waves)
            if label:  # they are not compared but measured together
                seeds = row_seeds(noise_seed, len(action) * num)
            else:  # the same noise for all candidates
                seeds = row_seeds(noise_seed, num).repeat(len(action))
            x = noise.sample(mean.flatten(0, 1), seeds).float().reshape(mean.shape)
            return CandidateSimulations(
                theta, action, x, mean, noise, missing=_if_any(missing)
            )
        x, missing = run(self.simulator, action, "x")
        again = None
        if paired:
            again, lost = run(self.simulator, action, "again")
            missing |= lost
        return CandidateSimulations(
            theta, action, x, replicate=again, missing=_if_any(missing)
        )

    def _lost_by_luck(
        self, rows: tuple[Tensor, Tensor], mean: Tensor, most: int = 64
    ) -> bool:
        """Simulate some rows without a measurement again: is there one this time.

        Then presence is random given the parameters, and only replicates tell how much.
        """
        present = mean.flatten(1).isfinite()
        lost = torch.nonzero(~present.all(1))[:, 0]
        if len(lost) == 0:
            return False
        lost = lost[:: -(-len(lost) // most)]
        assert isinstance(self.simulator, SimulatorModel)
        theta, action = (part[lost] for part in rows)
        seed = derive_seed(self.seed, "retry")
        again = self._simulate(self.simulator.mean, (theta, action), seed)
        self.num_drawn += len(again)
        self.num_missing += again.counts["missing"]
        known = again.status != Outcome.MISSING
        same = again.x.flatten(1).isfinite() == present[lost]
        return not bool(same[known].all())

    def _probe(self, num: int = 16) -> bool:
        """Look at a few rows: is there noise, and is the declared mean reproducible."""
        with forked_generators(self.seed, "probe"):
            theta = self.belief.sample((num,))
        action = self.action[torch.arange(num) % len(self.action)]

        def run(simulator: Callable[..., Any], key: str) -> Tensor:
            seed = derive_seed(self.seed, "probe", key)
            return self._simulate(simulator, (theta, action), seed).x

        x = run(self.simulator, "first")
        self._num_numbers = x[0].numel()
        require_noise(x, run(self.simulator, "second"))
        model = self.simulator
        if not isinstance(model, SimulatorModel) or model.noise is None:
            return False
        reproducible = run(_Reproducible(model), "reproducible")
        return bool((reproducible[reproducible.isfinite()] == 1).all())

    def _simulate(
        self, simulator: Callable[..., Any], rows: tuple[Tensor, Tensor], seed: int
    ) -> Simulations:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)  # they are counted
            return simulate(simulator, *rows, seed=seed, workers=self.workers)


@dataclass(frozen=True)
class _Reproducible:
    """Says of rows whether the noise-free output is, where a fault costs no more."""

    model: SimulatorModel

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        same = self.model.is_deterministic(theta, action)
        return torch.full((len(theta), 1), float(same))


def _rows(theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return parameters and actions of every row, action by action."""
    return theta.repeat(len(action), 1), action.repeat_interleave(len(theta), 0)


def _if_any(missing: Tensor) -> Tensor | None:
    return missing if bool(missing.any()) else None
