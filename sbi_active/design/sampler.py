"""Simulations of candidate actions, with what is known of their noise."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    Sampler,
    noise_scale,
)
from sbi_active.design.outcomes import LinearSummaries, join_outcomes
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.simulation import (
    GaussianNoise,
    MissingRowsWarning,
    Outcome,
    Simulations,
    SimulatorModel,
    simulate,
)
from sbi_active.simulation.simulator import require_noise
from sbi_active.simulation.workers.settings import Workers


@dataclass(eq=False)
class CandidateSampler(Sampler):
    """Draw parameters from the belief and simulate candidates at them.

    Attributes:
        simulator: ``simulator(theta, action)``.
        belief: Distribution of the parameters.
        probed: Actions to look at the simulator with, shape (a, action_dim).
        seed: Seed of all draws.
        workers: Workers that run the simulations.
        others: Actions whose outcomes will be known as well, shape (p, action_dim);
            every draw then holds joint outcomes (:func:`.join_outcomes`).
        most_numbers: Number of an outcome's numbers beyond which
            :class:`.LinearSummaries` stand for them, where noise is declared that
            allows for it; infinite keeps all.
        replicates: Whether half of the simulations repeat the parameters of the others,
            unless the noise is declared.
        has_slopes: Whether draws have slopes of the simulator.
        declared: Whether the simulator declares its noise around an output that does
            not change from run to run.
    """

    simulator: Any
    belief: Distribution
    probed: Tensor
    seed: int
    workers: Workers
    most_numbers: float
    replicates: bool
    others: Tensor
    has_slopes: bool = False

    def __post_init__(self) -> None:
        self.declared = self._probe(self.probed)
        noise = getattr(self.simulator, "noise", None)
        many = self.declared and self._num_numbers > self.most_numbers
        if many and noise is not None and noise.is_known_gaussian:
            self.summaries = LinearSummaries(noise)

    def draw(self, num_samples: int, action: Tensor) -> CandidateSimulations:
        """Simulate candidates (a, action_dim) at fresh parameters, the same for all."""
        self._num_waves += 1
        num = num_samples // 2 if self._is_paired else num_samples
        with forked_generators(self.seed, "theta", self._num_waves):
            theta = self.belief.sample((num,))
        drawn = self._draw(theta, action, "")
        if drawn is not None and len(self.others):
            beside = self._draw(theta, self.others, "others")
            drawn = None if beside is None else join_outcomes(drawn, beside)
        if drawn is None:  # what is declared as noise-free is not
            self.declared, self.summaries = False, None
            return self.draw(num_samples, action)
        return self.add_slopes(drawn) if self.has_slopes else drawn

    def add_slopes(
        self, drawn: CandidateSimulations, *, most: int = 64, step: float = 0.003
    ) -> CandidateSimulations:
        """Return simulations with slopes at some of the parameters.

        Args:
            drawn: Simulations with declared noise.
            most: Number of parameters with slopes, if these are at most half as many
                further simulations; an error of .1 nat where they vary by .8.
            step: Step in each parameter towards the center, in deviations of the
                draws; a third is lost in single precision, three times as much is bent.
        """
        assert drawn.mean is not None
        theta, num_actions = drawn.theta, len(drawn.x)
        n, d = theta.shape
        rows = torch.linspace(0, n - 1, max(2, min(most, n // (2 * d)))).long()
        start = theta[rows]
        move = step * theta.std(0) * torch.where(start > theta.mean(0), -1.0, 1.0)
        moved = (start[:, None] + torch.diag_embed(move)).flatten(0, 1)
        steps = moved.unflatten(0, (len(rows), d)) - start[:, None]
        action = drawn.action[:, : self.others.shape[1]]
        mean = self._means(moved, action, "slopes")[0]
        if len(self.others):
            beside = self._means(moved, self.others, "slopes")[0].transpose(0, 1)
            beside = beside.expand(num_actions, *beside.shape)
            mean = torch.cat([mean[:, :, None], beside], 2)
        change = mean.unflatten(1, (len(rows), d)) - drawn.mean[:, rows, None]
        white = change.flatten(3).double() / noise_scale(drawn)[:, None, None]
        slope = white / steps.diagonal(dim1=1, dim2=2)[..., None]
        own = slope.unflatten(3, (1 + len(self.others), -1)).transpose(2, 3)
        fisher = torch.full((num_actions, n, own.shape[2], d, d), torch.nan).double()
        fisher[:, rows] = own @ own.mT
        return replace(drawn, fisher=fisher)

    @property
    def notes(self) -> list[str]:
        """Notes on the summaries that stand for an outcome."""
        short = self.summaries
        return [] if short is None else [short.note(self._num_numbers)]

    @property
    def _is_paired(self) -> bool:
        return self.replicates and not self.declared

    def _draw(
        self, theta: Tensor, action: Tensor, label: str
    ) -> CandidateSimulations | None:
        """Simulate actions (a, action_dim) at parameters (n, theta_dim).

        Twice in pairs; None if the declared mean turns out to change from run to
        run. The label is the seeds': outcomes that are joined have noise of their own.
        """
        if self.declared:
            return self._draw_declared(theta, action, label)
        x, missing = self._run(self.simulator, theta, action, label + "x")
        again = None
        if self._is_paired:
            again, lost = self._run(self.simulator, theta, action, label + "again")
            missing |= lost
        return CandidateSimulations(theta, action, x, replicate=again, missing=missing)

    def _draw_declared(
        self, theta: Tensor, action: Tensor, label: str
    ) -> CandidateSimulations | None:
        mean, missing = self._means(theta, action, label + "x")
        measured = mean.flatten(2).isfinite() | missing[..., None]
        if self._num_waves == 1 and self._lost_by_luck(theta, action, measured):
            return None
        short = self.summaries
        noise = self.simulator.noise if short is None else GaussianNoise(1.0)
        assert noise is not None
        seed = derive_seed(self.seed, label + "noise", self._num_waves)
        if label:  # they are not compared but measured together
            seeds = row_seeds(seed, len(action) * len(theta))
        else:  # the same noise for all candidates
            seeds = row_seeds(seed, len(theta)).repeat(len(action))
        x = noise.sample(mean.flatten(0, 1), seeds).float().reshape(mean.shape)
        return CandidateSimulations(theta, action, x, mean, noise, missing=missing)

    def _means(
        self, theta: Tensor, action: Tensor, key: str, *, block: int = 512
    ) -> tuple[Tensor, Tensor]:
        """Return noise-free outcomes (a, n, *x_shape) and which are missing (a, n).

        Long ones are kept in memory for so many rows of an action at a time: of 10,000
        numbers these take some 200 MB.
        """
        short, run = self.summaries, self.simulator.mean
        if short is None:
            return self._run(run, theta, action, key)
        means, lost = [], []
        for own, some in product(action.split(1), theta.split(block)):
            mean, missing = self._run(run, some, own, key)
            means.append(short(own[0], mean[0]))
            lost.append(missing[0])
        shape = len(action), len(theta)
        return torch.cat(means).unflatten(0, shape), torch.cat(lost).reshape(shape)

    def _run(
        self, simulator: Callable[..., Any], theta: Tensor, action: Tensor, key: str
    ) -> tuple[Tensor, Tensor]:
        """Return outcomes (a, n, *x_shape) and which are missing (a, n)."""
        rows = theta.repeat(len(action), 1), action.repeat_interleave(len(theta), 0)
        drawn = self._simulate(simulator, rows, key, self._num_waves)
        self.num_drawn += len(drawn)
        self.num_missing += drawn.counts["missing"]
        shape = (len(action), len(theta))
        x = drawn.x.reshape(*shape, *drawn.x.shape[1:])
        return x, (drawn.status == Outcome.MISSING).reshape(shape)

    def _lost_by_luck(
        self, theta: Tensor, action: Tensor, present: Tensor, most: int = 64
    ) -> bool:
        """Simulate some rows that lack numbers again: are there any this time.

        Then presence is random given the parameters, and only replicates tell how much.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (a, action_dim).
            present: Mask of the numbers that there are, shape (a, n, q).
            most: Number of rows to simulate again.
        """
        a, i = torch.nonzero(~present.all(2), as_tuple=True)
        if len(a) == 0:
            return False
        some = slice(None, None, -(-len(a) // most))
        a, i = a[some], i[some]
        again = self._simulate(self.simulator.mean, (theta[i], action[a]), "retry")
        self.num_drawn += len(again)
        self.num_missing += again.counts["missing"]
        known = again.status != Outcome.MISSING
        measured = again.x.flatten(1).isfinite()
        if self.summaries is not None:
            measured = measured.all(1, keepdim=True)
        return not bool((measured == present[a, i])[known].all())

    def _probe(self, probed: Tensor, num: int = 16) -> bool:
        """Look at a few rows: is there noise, and is the declared mean reproducible."""
        with forked_generators(self.seed, "probe"):
            theta = self.belief.sample((num,))
        rows = theta, probed[torch.arange(num) % len(probed)]

        def run(simulator: Callable[..., Any], key: str) -> Tensor:
            return self._simulate(simulator, rows, "probe", key).x

        x = run(self.simulator, "first")
        self._num_numbers = x[0].numel()
        require_noise(x, run(self.simulator, "second"))
        model = self.simulator
        if not isinstance(model, SimulatorModel) or model.noise is None:
            return False
        reproducible = run(partial(_reproducible, model), "reproducible")
        return bool((reproducible[reproducible.isfinite()] == 1).all())

    def _simulate(
        self, simulator: Callable[..., Any], rows: tuple[Tensor, Tensor], *key: Any
    ) -> Simulations:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)  # they are counted
            seed = derive_seed(self.seed, *key)
            return simulate(simulator, *rows, seed=seed, workers=self.workers)


def _reproducible(model: SimulatorModel, theta: Tensor, action: Tensor) -> Tensor:
    """Say of rows whether the noise-free output is, where a fault costs no more."""
    return torch.full((len(theta), 1), float(model.is_deterministic(theta, action)))
