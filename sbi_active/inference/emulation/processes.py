"""Gaussian processes on few simulations, a trial each, put where they tell most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.likelihood import (
    PooledLikelihood,
    TrialLikelihood,
    correlation_root,
    declared_process,
    learned_processes,
)
from sbi_active.inference.emulation.pool import Pool
from sbi_active.inference.emulation.summaries import Summary
from sbi_active.inference.engine.importance import fitted
from sbi_active.inference.engine.learned import CHEAP
from sbi_active.inference.engine.pool import PriorDraws
from sbi_active.inference.refinement.stages import Stage, Stages, StageSettings
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.regions import Region, whole_space
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.gaussian_process import num_features
from sbi_active.inference.sampling.mixtures import Defended
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.noise.base import NoiseModel

#: The loop of few simulations. It begins with rows that are there, and ends where the
#: processes' own errors are small: no stage is spent on seeing that one more changes
#: nothing. A check by fresh rows would take more than a belief has.
FEW_ROWS = StageSettings(
    first_share=0.0,
    stage_share=0.35,
    fewest=12,
    oversampling=15.0,
    settled=np.inf,
    untrusted=0.2,
    checked_share=0.0,
)


@dataclass(frozen=True)
class PooledTrial:
    """A real trial.

    Attributes:
        action: Executed, as simulated, shape (action_dim,).
        x: Raw outcome, shape x_shape.
        label: Label of the summary of the outcome; None takes the best.
    """

    action: Tensor
    x: Tensor
    label: str | None = None


class Processes(Stages):
    """Learns the likelihood of each trial from the rows at its action.

    Args:
        prior: The original prior.
        pool: Pool of raw simulations, noise-free if noise is declared.
        noise: Declared noise; None if the simulator draws it.
        x_shape: Shape of a raw outcome.
        summaries: Summaries of raw outcomes.
        settings: Settings of the belief.
        before: The belief before the last trial; it says where to look first.
        seed: Seed of everything random here.
        num_reference: Number of draws of a belief that say where simulations matter.
    """

    def __init__(
        self,
        prior: Distribution,
        pool: Pool,
        noise: NoiseModel | None,
        x_shape: tuple[int, ...],
        summaries: Sequence[Summary],
        settings: RefinementOptions,
        before: Distribution,
        *,
        seed: int,
        num_reference: int = 400,
    ) -> None:
        rng = np.random.default_rng(derive_seed(seed, "pooled"))
        coordinates = PriorCoordinates(prior, np.random.default_rng(0))
        super().__init__(prior, settings, FEW_ROWS, 0, rng, coordinates)
        self.pool, self.noise, self.num_reference = pool, noise, num_reference
        self.x_shape, self.summaries, self.seed = x_shape, summaries, seed
        with forked_generators(derive_seed(seed, "reference")):
            theta = before.sample(torch.Size([num_reference]))
        self.near: Array = self.coordinates.to_z(theta.float())
        self.trials: Sequence[PooledTrial] = ()
        self.labels: list[str] = []
        self._at_start = self._num_rows

    def begin(self, trials: Sequence[PooledTrial], budget: int) -> None:
        """Settle the summary that each trial is seen by.

        Args:
            trials: All of them.
            budget: Simulations at most.
        """
        self.trials, self.budget = trials, budget
        self.labels = [self.best_summary(trial) for trial in trials]

    @property
    def _num_rows(self) -> int:
        return len(self.pool) + self.pool.num_missing

    def spent(self) -> tuple[int, int]:
        """Return the rows simulated here, twice."""
        num = self._num_rows - self._at_start
        return num, num

    def fit(self, near: Array | None, *, is_last: bool) -> PooledLikelihood:
        """Return the likelihood of all trials."""
        assert near is not None
        fits = [
            self.fit_trial(trial, label, near)
            for trial, label in zip(self.trials, self.labels, strict=True)
        ]
        return PooledLikelihood(self.coordinates, tuple(fits))

    def judged(
        self, surrogate: PooledLikelihood, draws: Array
    ) -> tuple[float, Array, float]:
        """Return no misfit, one region, and the expected error."""
        errors = [trial.error(draws) for trial in surrogate.trials]
        return 0.0, np.ones(1), float(sum(errors))

    def tails(self, stage: Stage) -> list[float]:
        """Return tail probabilities of the trials and, last, of all together."""
        tails = [trial.tail(stage.draws) for trial in stage.surrogate.trials]
        return [*tails, min(1.0, len(tails) * min(tails))]

    def best_summary(self, trial: PooledTrial) -> str:
        """Return the summary by which a trial is expected to tell most."""
        if trial.label is not None or len(self.summaries) == 1:
            return trial.label or self.summaries[0].label
        gains = []
        for summary in self.summaries:
            rng = np.random.default_rng(derive_seed(self.seed, "gain"))
            fitted = self.fit_trial(trial, summary.label, self.near)
            gains.append(fitted.gain(self.near, rng))
        return self.summaries[int(np.argmax(gains))].label

    def fit_trial(
        self,
        trial: PooledTrial,
        label: str,
        reference: Array,
        *,
        most_declared: int = 160,
        most_learned: int = 400,
    ) -> TrialLikelihood:
        """Return the likelihood of a trial from the rows of its action.

        Args:
            trial: The trial.
            label: Label of its summary.
            reference: Draws of a belief that say where it matters, shape (n, d).
            most_declared: Number of rows at most where noise is declared.
            most_learned: Number where it is learned.
        """
        rows = self.pool.at(trial.action)
        summary = next(s for s in self.summaries if s.label == label)
        z, needed = self.coordinates.to_z(rows.theta), self.coordinates.dim + 4
        observed, numbers = summary(trial.x[None].float())[0], summary(rows.x)
        # Where nothing was measured on one side, that is one NaN.
        width = max(numbers.shape[1], len(observed))
        numbers = np.broadcast_to(numbers, (len(numbers), width))
        observed = np.broadcast_to(observed, width)
        used, kind = np.isfinite(observed), np.isfinite(numbers)
        # As the trial had a measurement, or none.
        agrees = np.asarray(kind[:, used].all(1) if used.any() else ~kind.any(1))
        outcome, whole = None, whole_space(z.shape[1])
        if not (agrees.all() and len(agrees)):
            none = np.zeros((0, 2), dtype=bool)
            outcome = TrialOutcome.fit(whole, 0, z, agrees, none)
        own = TrialLikelihood(
            *(whole, (), observed[used], self.noise, self.x_shape, used),
            root=np.eye(used.sum()),
            outcome=outcome,
        )
        if not used.any():
            return own
        if agrees.sum() < needed:
            raise UnexplainedOutcomeError(
                f"expected at least {needed} simulations with a measurement at "
                f"{trial.action.tolist()}; got {int(agrees.sum())} of {len(rows)}; "
                "allow more simulations, or leave the trial out"
            )
        most = most_learned if self.noise is None else most_declared
        near, region = nearest(z, agrees, reference, most)
        inputs, values = region.scaled(z[near]), numbers[near][:, used]
        if self.noise is not None:
            return replace(
                own, region=region, processes=(declared_process(inputs, values),)
            )
        statistic, processes, left_out = learned_processes(
            inputs, values, z[near], seed=self.seed
        )
        return replace(
            own,
            region=region,
            processes=processes,
            observed=statistic(observed[used][None])[0],
            root=correlation_root(left_out),
            freedom=max(5.0, len(near) - 1.0 - z.shape[1]),
        )

    def simulate(self, size: int, *, share_of_prior: float = 0.1) -> None:
        """Add rows at the trials that know least."""
        if size == 0:
            return
        stage = self.stages[-1]
        own, potential = CHEAP, stage.fit.potential
        c, draws = potential.coordinates, stage.draws[: self.num_reference]
        weight = np.full(len(draws), 1 / len(draws))
        near = fitted(c.from_z(draws), weight, own.num_components, own, self.rng)
        where = Defended(near, PriorDraws(potential), share_of_prior)
        errors = [t.error(draws) + 1e-9 for t in stage.surrogate.trials]
        counts = self.rng.multinomial(size, np.array(errors) / sum(errors))
        kept: list[Array] = []
        while sum(map(len, kept)) < size:
            u = potential.simulated(where.sample(2 * size + 20, self.rng))
            kept.append(self.rng.permutation(u))
        u = np.concatenate(kept)[:size]
        z = c.to_z(u)
        log_q = where.log_prob(u) + c.log_slope(u) - self.coordinates.log_jacobian(z)
        pairs = zip(self.trials, counts, strict=True)
        self.pool.simulate(
            self.coordinates.to_theta(z),
            torch.cat([t.action.expand(int(n), -1) for t, n in pairs]),
            seed=derive_seed(self.seed, "rows", len(self.pool.batches)),
            log_proposal=torch.from_numpy(log_q),
        )


def nearest(
    z: Array,
    valid: NDArray[np.bool_],
    reference: Array,
    most: int,
    *,
    reach: float = 6.0,
    floor: float = 1e-4,
) -> tuple[NDArray[np.intp], Region]:
    """Return the rows nearest to a belief, and coordinates of their size.

    Rows far from it would make what is close to it look as if it were one place.

    Args:
        z: Coordinates of simulations, shape (n, d).
        valid: Which of them may be taken, shape (n,).
        reference: Draws from the belief, shape (m, d).
        most: Rows to take.
        reach: Deviations of the belief within which rows are near it.
        floor: Deviation at least, in half-widths of the prior.
    """
    center, dim = reference.mean(0), z.shape[1]
    covariance = np.atleast_2d(np.cov(reference.T)) + floor**2 * np.eye(dim)
    region = Region(center, np.linalg.cholesky(covariance), 1.0)
    distance = np.where(valid, np.linalg.norm(region.scaled(z), axis=1), np.inf)
    near = np.argsort(distance, kind="stable")[: min(most, int(valid.sum()))]
    enough = min(len(near), 3 * num_features(dim + 2))
    reach = max(reach * np.sqrt(dim), distance[near[enough - 1]])
    near = near[distance[near] <= reach]
    size = np.sqrt((distance[near] ** 2).mean() / dim)
    return near, Region(center, region.factor, max(1.0, float(size)))
