"""The posterior of all trials, from few simulations that are put where they tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.emulation.gain import mixture_gain
from sbi_active.inference.emulation.likelihood import (
    PooledLikelihood,
    TrialLikelihood,
    correlation_root,
)
from sbi_active.inference.emulation.pool import Pool
from sbi_active.inference.emulation.statistics import learned_statistic
from sbi_active.inference.emulation.summaries import Summary
from sbi_active.inference.engine.importance import fitted
from sbi_active.inference.engine.learned import CHEAP, LearnedFit, learned_fit
from sbi_active.inference.engine.pool import PriorDraws
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.process import (
    GaussianProcess,
    ProcessSettings,
    num_features,
)
from sbi_active.inference.regression.regions import Region, whole_space
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.student_mixture import Defended
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.noise.base import NoiseModel

Array = NDArray[Any]

NUM_REFERENCE = 400  # draws of a belief that say where simulations matter
MOST_ROWS = {True: 160, False: 400}  # behind a trial, with declared noise and without
NUM_STAGES = 5
STAGE_SHARE = 0.35  # of the allowance
FEWEST_ROWS = 12  # of a stage
ENOUGH = 0.01  # nats: then no further simulation
LARGE = 0.2  # nats that a belief is off
DEFENSIVE = 1e-5
NUM_OUTER, NUM_INNER = 128, 600  # draws behind the gain of a summary
REACH = 6.0  # deviations of the belief within which rows are near it
SHARE_OF_PRIOR = 0.1  # of new rows, so that no place is never looked at
FLOOR = 1e-4  # deviation at least, in half-widths of the prior


@dataclass(frozen=True)
class PooledTrial:
    """A real trial.

    Attributes:
        action: Executed, as simulated, shape (action_dim,).
        x: Raw outcome, shape x_shape.
        label: Of the summary that it is to be seen by; None takes the best.
    """

    action: Tensor
    x: Tensor
    label: str | None = None


class PooledPosterior:
    """Learns the likelihood of each trial and samples the posterior of all.

    Args:
        prior: The original prior.
        pool: Of raw simulations, noise-free where noise is declared.
        noise: That was declared; None where the simulator is the noise.
        x_shape: Of a raw outcome.
        summaries: Of raw outcomes.
        seed: Of everything random here.
    """

    def __init__(
        self,
        prior: Distribution,
        pool: Pool,
        noise: NoiseModel | None,
        x_shape: tuple[int, ...],
        summaries: Sequence[Summary],
        *,
        seed: int,
    ) -> None:
        self.prior, self.pool, self.noise = prior, pool, noise
        self.x_shape, self.summaries, self.seed = x_shape, summaries, seed
        self.rng = np.random.default_rng(derive_seed(seed, "pooled"))
        self.coordinates = PriorCoordinates(prior, np.random.default_rng(0))

    def run(
        self, trials: Sequence[PooledTrial], *, before: Distribution, allowance: int
    ) -> tuple[LearnedBelief, list[str]]:
        """Return the belief, and the summary that each trial is seen by.

        Args:
            trials: All of them.
            before: The belief before the last one; it says where to look first.
            allowance: Simulations at most.

        Raises:
            UnexplainedOutcomeError: If nothing has a likelihood.
        """
        at_start, start = len(self.pool), self.pool.num_missing
        reference = self.draws(before)
        labels = [self.best_summary(t, reference) for t in trials]
        left = allowance
        for stage in range(NUM_STAGES + 1):
            fits = tuple(
                self.fit(t, label, reference)
                for t, label in zip(trials, labels, strict=True)
            )
            likelihood = PooledLikelihood(self.coordinates, fits)
            fit = learned_fit(likelihood, self.rng, near=reference)
            if fit is None:
                raise UnexplainedOutcomeError(
                    "expected outcomes that some parameters may explain; got none with "
                    "a likelihood; correct the outcome, or leave the trial out"
                )
            reference = fit.draws(NUM_REFERENCE, self.rng)
            errors = np.array([one.error(reference) for one in fits])
            size = min(left, max(FEWEST_ROWS, int(STAGE_SHARE * allowance)))
            size = left if left - size < FEWEST_ROWS else size
            if size < FEWEST_ROWS or errors.sum() < ENOUGH or stage == NUM_STAGES:
                break
            self._simulate(trials, errors, fit, reference, size)
            left -= size
        spent = len(self.pool) + self.pool.num_missing - at_start - start
        return self._belief(fit, fits, errors, spent), labels

    def draws(self, belief: Distribution) -> Array:
        """Return coordinates of draws from a belief, shape (n, d)."""
        with forked_generators(derive_seed(self.seed, "reference")):
            theta = belief.sample(torch.Size([NUM_REFERENCE]))
        return self.coordinates.to_z(theta.float())

    def best_summary(self, trial: PooledTrial, reference: Array) -> str:
        """Return the summary by which a trial is expected to tell most."""
        if trial.label is not None or len(self.summaries) == 1:
            return trial.label or self.summaries[0].label
        gains = [
            self.gain(self.fit(trial, summary.label, reference), reference)
            for summary in self.summaries
        ]
        return self.summaries[int(np.argmax(gains))].label

    def gain(self, fitted: TrialLikelihood, reference: Array) -> float:
        """Return the information of an outcome at a trial's action, nats."""
        if not fitted.processes:
            return 0.0
        z = np.resize(reference, (NUM_OUTER + NUM_INNER, reference.shape[1]))
        mean, variance = fitted.predict(z)
        if self.noise is None:
            root = fitted.learned_sd[:, None] * fitted.root
        else:
            root = np.diag(fitted.declared_sd)
        rng = np.random.default_rng(derive_seed(self.seed, "gain"))
        normal = rng.standard_normal((NUM_OUTER, mean.shape[1]))
        return float(mixture_gain(mean, variance, root, normal, NUM_OUTER).mean())

    def fit(self, trial: PooledTrial, label: str, reference: Array) -> TrialLikelihood:
        """Return the likelihood of a trial from the rows of its action."""
        rows = self.pool.at(trial.action)
        summary = next(s for s in self.summaries if s.label == label)
        z = self.coordinates.to_z(rows.theta)
        observed = summary(trial.x[None].float())[0]
        numbers = summary(rows.x)
        if numbers.shape[1] != len(observed):  # nothing measured on one side
            width = max(numbers.shape[1], len(observed))
            numbers, observed = _wide(numbers, width), _wide(observed[None], width)[0]
        used = np.isfinite(observed)
        valid = np.isfinite(numbers[:, used]).all(1) & used.any()
        outcome = self._outcome(z, numbers, used)
        region = Region(np.zeros(z.shape[1]), np.eye(z.shape[1]), 1.0)
        processes: tuple[GaussianProcess, ...] = ()
        root, freedom, seen = np.eye(1), 1.0, observed[used]
        needed = z.shape[1] + 4
        if used.any() and valid.sum() < needed:
            raise UnexplainedOutcomeError(
                f"expected at least {needed} simulations with a measurement at "
                f"{trial.action.tolist()}; got {int(valid.sum())} of {len(rows)}; allow"
                " more simulations, or leave the trial out"
            )
        if used.any():
            most = MOST_ROWS[self.noise is not None]
            near, region = nearest(z, valid, reference, most)
            inputs, values = region.scaled(z[near]), numbers[near][:, used]
            if self.noise is not None:
                kinds = ("smooth", "rough")
                both = [
                    GaussianProcess.fit(
                        inputs,
                        values,
                        noise="none",
                        settings=ProcessSettings(kind=kind),
                    )
                    for kind in kinds
                ]
                processes = (max(both, key=lambda p: p.log_evidence),)
            else:
                statistic, own = learned_statistic(
                    values, z[near], seed=derive_seed(self.seed, "folds")
                )
                seen = statistic(observed[used][None])[0]
                processes = tuple(
                    GaussianProcess.fit(inputs, own[:, [j]], noise="learned")
                    for j in range(own.shape[1])
                )
                left_out = np.concatenate([p.left_out for p in processes], 1)
                root = correlation_root(left_out)
                freedom = max(5.0, len(near) - 1.0 - z.shape[1])
        return TrialLikelihood(
            region=region,
            processes=processes,
            observed=seen,
            noise=self.noise,
            x_shape=self.x_shape,
            used=used,
            root=root,
            freedom=freedom,
            outcome=outcome,
            label=label,
            num_rows=len(rows),
        )

    def _outcome(
        self, z: Array, numbers: Array, used: NDArray[np.bool_]
    ) -> TrialOutcome | None:
        """Return the probability that a trial has a measurement, as it had, or none."""
        if used.any():
            agrees = np.asarray(np.isfinite(numbers[:, used]).all(1))
        else:
            agrees = np.asarray(~np.isfinite(numbers).any(1))
        if agrees.all() and len(agrees):
            return None
        pairs = np.zeros((0, 2), dtype=bool)
        return TrialOutcome.fit(whole_space(z.shape[1]), 0, z, agrees, pairs)

    def _simulate(
        self,
        trials: Sequence[PooledTrial],
        errors: Array,
        fit: LearnedFit,
        reference: Array,
        size: int,
    ) -> None:
        """Add rows at the trials that know least, where the posterior is."""
        own, c = CHEAP, fit.potential.coordinates
        weight = np.full(len(reference), 1 / len(reference))
        near = fitted(c.from_z(reference), weight, own.num_components, own, self.rng)
        where = Defended(near, PriorDraws(fit.potential), SHARE_OF_PRIOR)
        counts = self.rng.multinomial(size, (errors + 1e-9) / (errors + 1e-9).sum())
        kept: list[Array] = []
        while sum(map(len, kept)) < size:
            u = fit.potential.simulated(where.sample(2 * size + 20, self.rng))
            kept.append(self.rng.permutation(u))
        u = np.concatenate(kept)[:size]
        z = c.to_z(u)
        log_q = where.log_prob(u) + c.log_slope(u) - self.coordinates.log_jacobian(z)
        action = torch.cat(
            [t.action.expand(int(n), -1) for t, n in zip(trials, counts, strict=True)]
        )
        self.pool.simulate(
            self.coordinates.to_theta(z),
            action,
            seed=derive_seed(self.seed, "rows", len(self.pool.batches)),
            log_proposal=torch.from_numpy(log_q),
        )

    def _belief(
        self,
        fit: LearnedFit,
        fits: Sequence[TrialLikelihood],
        errors: Array,
        spent: int,
    ) -> LearnedBelief:
        belief = LearnedBelief(self.prior, fit, defensive=DEFENSIVE)
        z = fit.draws(NUM_REFERENCE, self.rng)
        tails = tuple(_tail(one, z, self.rng) for one in fits)
        effective = float(fit.fit.effective_sample_size)
        error = float(errors.sum())
        found = Diagnostics(
            trustworthy=True,
            num_simulations=spent,
            effective_sample_size=effective,
            error_nats=error,
            error_nats_if_explained=error,
            tail_probability=min(1.0, len(tails) * min(tails)),
            tail_probability_of_trial=tails,
        )
        if error > LARGE:
            found = found.warned(
                f"SA105 the belief is off by about {error:.2g} nats for want of "
                "simulations; allow more of them"
            )
        if effective < 100:
            found = found.warned("SA114 few effective draws; allow more simulations")
        belief.diagnostics = found
        return belief


def nearest(
    z: Array, valid: NDArray[np.bool_], reference: Array, most: int
) -> tuple[NDArray[np.intp], Region]:
    """Return the rows nearest to a belief, and coordinates of their size.

    Rows far from it would make what is close to it look as if it were one place.

    Args:
        z: Of simulations, shape (n, d).
        valid: Which of them may be taken, shape (n,).
        reference: Draws from the belief, shape (m, d).
        most: Rows to take.
    """
    center, dim = reference.mean(0), z.shape[1]
    covariance = np.atleast_2d(np.cov(reference.T)) + FLOOR**2 * np.eye(dim)
    region = Region(center, np.linalg.cholesky(covariance), 1.0)
    distance = np.where(valid, np.linalg.norm(region.scaled(z), axis=1), np.inf)
    near = np.argsort(distance, kind="stable")[: min(most, int(valid.sum()))]
    enough = min(len(near), 3 * num_features(dim + 2))
    reach = max(REACH * np.sqrt(dim), distance[near[enough - 1]])
    near = near[distance[near] <= reach]
    size = np.sqrt((distance[near] ** 2).mean() / dim)
    return near, Region(center, region.factor, max(1.0, float(size)))


def _wide(numbers: Array, width: int) -> Array:
    """Return numbers (n, d) with NaN up to a width."""
    full = np.full((len(numbers), width), np.nan)
    full[:, : numbers.shape[1]] = numbers
    return full


def _tail(fitted: TrialLikelihood, z: Array, rng: np.random.Generator) -> float:
    """Return how often a simulation from the belief lies as far out as a trial."""
    if not fitted.processes:
        return 1.0
    mean, variance = fitted.predict(z)
    if fitted.noise is None:
        sd, root = np.sqrt(fitted.learned_sd**2 + variance), fitted.root
    else:
        sd, root = np.sqrt(fitted.declared_sd**2 + variance), np.eye(mean.shape[1])
    white = np.linalg.solve(root, ((fitted.observed - mean) / sd).T).T
    return float(chi2.sf((white**2).sum(1), mean.shape[1]).mean())
