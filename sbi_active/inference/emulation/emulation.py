"""The one loop behind a learned likelihood: propose, simulate, fit, sample, judge.

Simulations of each action are added to a pool where the last belief lies, and of the
actions that are known least; the likelihood that is fitted to them is sampled without
simulations. The budget and where the loop ends are settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.declared.diagnosing import Contradiction, compared
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.checks import (
    Fresh,
    compared_with_fresh,
    diagnosed,
    predicted_tails,
)
from sbi_active.inference.emulation.emulator import EmulatedLikelihood, emulated
from sbi_active.inference.emulation.gains import mixture_gain
from sbi_active.inference.emulation.outcomes import Summary
from sbi_active.inference.emulation.pool import (
    EmulatedTrial,
    Pool,
    TrialRows,
    noise_sds,
    pairs_of,
    rows_seen,
)
from sbi_active.inference.emulation.regression import (
    Regression,
    fewest_rows,
    is_misfit,
)
from sbi_active.inference.emulation.residuals import ShapeSettings
from sbi_active.inference.emulation.solving import Region, around, whole_space
from sbi_active.inference.emulation.stages import (
    EmulationSettings,
    Stage,
    largest_error,
)
from sbi_active.inference.engine.importance import fitted
from sbi_active.inference.engine.learned import (
    LearnedBelief,
    LearnedPotential,
    learned_fit,
)
from sbi_active.inference.engine.pool import PriorDraws
from sbi_active.inference.engine.settings import CHEAP
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.mixtures import Defended, Proposal
from sbi_active.seeding import derive_seed
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.simulator import require_noise


class Emulation:
    """The loop of one belief.

    Args:
        prior: The original prior.
        coordinates: Coordinates of the prior.
        pool: Pool of raw simulations, noise-free if noise is declared.
        trials: All trials.
        summaries: Summaries of raw outcomes.
        settings: Settings of the belief.
        own: Settings of the loop.
        budget: Rows at most, those of the pool not counted.
        near: Coordinates of draws that say where to look first, shape (n, d).
        noise: Declared noise; None if the simulator draws it.
        seed: Seed of everything random here.

    Attributes:
        stages: The stages so far.
        labels: Label of each trial's summary.
        fresh: What fresh simulations say of the last stage.
        off: Largest error of its log weights, nats; inf where none was compared.
    """

    def __init__(
        self,
        prior: Distribution,
        coordinates: PriorCoordinates,
        pool: Pool,
        trials: Sequence[EmulatedTrial],
        summaries: Sequence[Summary],
        settings: RefinementOptions,
        own: EmulationSettings,
        *,
        budget: int,
        near: Array,
        noise: NoiseModel | None = None,
        seed: int,
    ) -> None:
        self.prior, self.coordinates, self.pool = prior, coordinates, pool
        self.trials, self.settings, self.own = trials, settings, own
        self.summaries = {summary.label: summary for summary in summaries}
        self.budget, self.near, self.noise, self.seed = budget, near, noise, seed
        self.rng = np.random.default_rng(derive_seed(seed, "emulation"))
        self.stages: list[Stage] = []
        self.labels: list[str] = []
        self.fresh: Fresh | None = None
        self._shape_change = 0.0
        len(pool)  # which brings back its rows
        self._at_start = pool.num_drawn
        self.off = np.inf
        self._actions = torch.stack([t.action for t in trials]).unique(dim=0)
        each = int(own.weighed_share * budget / len(self._actions))
        self._num_weighed = 0 if noise is None else min(own.num_weighed, each)
        self._least = own.fewest  # rows of which fewer are no stage
        if own.first_share:
            least = max(own.fewest, 2 * fewest_rows(coordinates.dim))
            self._least = least * len(self._actions)

    def run(self) -> LearnedBelief:
        """Return the belief of the last stage that explains the trials.

        Raises:
            UnexplainedOutcomeError: If nothing has a likelihood.
        """
        stages, own = self.stages, self.own
        self.labels = [self.best_summary(trial) for trial in self.trials]
        is_whole = own.first_share > 0
        region = whole_space(self.coordinates.dim) if is_whole else around(self.near)
        size = self._size(own.first_share)
        while True:
            self._simulate(size)
            size = self._size(own.stage_share)
            is_last = size < self._least
            try:
                stage = self._sampled(self._fitted(region, is_cautious=not is_last))
            except UnexplainedOutcomeError:
                if not stages:
                    raise
                break  # beyond what any parameters explain, closer is no better
            stages.append(stage.after(stages[-1]) if stages else stage)
            self.near, region = stage.draws, around(stage.draws)
            if is_last or self._is_settled(stages[-1]):
                is_confirmed = self._is_confirmed(stages[-1])
                size = self._size(own.stage_share)
                if is_last or is_confirmed or size < self._least:
                    break
        if own.shapes is not None:
            stages[-1] = self._shaped(stages[-1], own.shapes)
        tails = self._tails(stages[-1])
        stages[-1].belief.diagnostics = diagnosed(
            *(stages, own, tails, self.fresh, self._rows()),
            *(self._shape_change, self.off, self.rng),
            num_simulations=self.pool.num_drawn - self._at_start,
            num_missing=self.pool.num_missing,
        )
        return stages[-1].belief

    def _size(self, share: float) -> int:
        """Return what the next stage spends, of a share of the budget."""
        if share == 0:  # there are simulations to begin with
            return 0
        size, left = max(int(share * self.budget), self._least), self.budget
        left -= self.pool.num_drawn - self._at_start
        left -= self._num_weighed * len(self._actions)
        # A remainder too small for a stage of its own goes to the one before.
        return left if left < size + self._least else size

    def _is_settled(self, stage: Stage) -> bool:
        """Return whether residuals are noise and the stage changed nothing."""
        own, dim = self.own, self.coordinates.dim
        is_settled = not np.isfinite(own.settled) or stage.change < own.settled * dim
        is_known = not is_misfit(stage.learned.excess) and stage.error <= own.small
        return is_known and is_settled

    def _is_confirmed(self, stage: Stage) -> bool:
        """Return whether simulations have the likelihood that it says.

        Half of them are draws of the belief, half of where it may be as well.
        """
        if self._num_weighed == 0:
            return True
        half = -(-self._num_weighed // 2)
        hopeful = replace(stage.learned, is_hopeful=True)
        other = learned_fit(hopeful, self.rng, near=stage.draws, oversampling=2.0)
        fits = stage.fit, other
        z = np.concatenate([fit.draws(half, self.rng) for fit in fits])
        z = z[: self._num_weighed]
        theta, t = self.coordinates.to_theta(z), len(self._actions)
        seed = derive_seed(self.seed, "weighed", len(self.pool.batches))
        self.pool.simulate(
            theta.repeat(t, 1),
            self._actions.repeat_interleave(len(theta), 0),
            seed=seed,
            log_proposal=stage.belief.log_prob(theta).repeat(t),
        )
        z = self.coordinates.to_z(theta)
        self.off = largest_error(fits, stage.learned, self._rows(), z)
        return self.off <= self.own.off

    def _sampled(self, learned: EmulatedLikelihood) -> Stage:
        """Return the stage of a likelihood, sampled."""
        num = self.settings.num_effective
        near = self.near if len(self.near) else None
        fit = learned_fit(learned, self.rng, near=near, num_effective=num)
        belief = LearnedBelief(self.prior, fit, defensive=self.settings.defensive)
        draws = fit.draws(1_000, self.rng)
        errors = [part.error(draws, self.rng) for part in learned.parts]
        return Stage(learned, fit, belief, draws, np.array([*errors, 0.0]))

    def _shaped(self, stage: Stage, shapes: ShapeSettings) -> Stage:
        """Return the stage with noise that is not Gaussian, where it is not."""
        learned = self._fitted(stage.learned.region, shapes=shapes)
        fits = [part for part in learned.parts if isinstance(part, Regression)]
        if all(fit.shape is None for fit in fits):
            return stage
        self.near = stage.draws
        other = self._sampled(learned)
        self._shape_change = other.after(stage).change
        errors = max(stage.errors, other.errors, key=np.sum)
        return replace(other, errors=errors, change=stage.change)

    def _simulate(self, size: int, *, least_repeated: int = 12) -> None:
        """Add so many rows, of the actions that are known least."""
        own, c, stages = self.own, self.coordinates, self.stages
        space = LearnedPotential(EmulatedLikelihood(c, whole_space(c.dim)))
        where, u_of = self._proposal(space), space.coordinates
        groups: Any = [range(len(self.trials))]
        errors = np.ones(1)
        if stages and stages[-1].learned.groups:
            groups, errors = [*stages[-1].learned.groups], stages[-1].errors[:-1] + 1e-9
            # Where others have no measurement is looked at beside the first.
            others = {*range(len(self.trials))} - {k for group in groups for k in group}
            groups[0] = (*groups[0], *others)
        counts = self.rng.multinomial(size, errors / errors.sum())
        parts: list[tuple[Any, ...]] = []
        for group, count in zip(groups, counts, strict=True):
            action = torch.stack([self.trials[k].action for k in group]).unique(dim=0)
            num = int(count) // len(action)
            if not stages and len(self.pool):  # known from the trials before
                is_new = [len(self.pool.at(place)) < num for place in action]
                action = action[torch.tensor(is_new)]
            if num == 0 or not len(action):
                continue
            repeated = max(int(own.replicate_share * num), least_repeated)
            repeated = min(repeated, num // 2) if own.replicate_share else 0
            u = np.zeros((0, c.dim))
            while len(u) < num - repeated:
                drawn = space.simulated(where.sample(2 * num + 20, self.rng))
                u = np.concatenate([u, self.rng.permutation(drawn)])
            u = np.concatenate([u[: num - repeated], u[:repeated]])
            z = u_of.to_z(u)
            log_q = where.log_prob(u) + u_of.log_slope(u) - c.log_jacobian(z)
            parts.append(
                (
                    c.to_theta(z).repeat(len(action), 1),
                    action.repeat_interleave(num, 0),
                    torch.from_numpy(log_q).repeat(len(action)),
                )
            )
        if not parts:
            return
        theta, action, log_proposal = map(torch.cat, zip(*parts, strict=True))
        is_first = not len(self.pool)
        seed = derive_seed(self.seed, "rows", len(self.pool.batches))
        self.pool.simulate(theta, action, seed=seed, log_proposal=log_proposal)
        if is_first and own.replicate_share:
            found = self.pool.at(action[0])
            first, second = pairs_of(found.theta).T
            require_noise(found.x[first], found.x[second])

    def _proposal(self, space: LearnedPotential) -> Proposal:
        """Return where to simulate: near the last belief, further off, and anywhere.

        Args:
            space: The prior in coordinates without edges.
        """
        own, prior = self.own, PriorDraws(space)
        if not len(self.near):
            return prior
        u = space.coordinates.from_z(self.near)
        equal = np.full(len(u), 1 / len(u))
        near: Any = fitted(u, equal, CHEAP.num_components, CHEAP, self.rng)
        if not self.stages and own.first_share:
            return Defended(near, prior, 0.5)
        if own.first_share and not is_misfit(self.stages[-1].learned.excess):
            far = replace(near, factors=own.far * near.factors)
            near = Defended(near, far, 0.5)
        return Defended(near, prior, own.share_of_prior)

    def _rows(self) -> list[TrialRows]:
        pairs = zip(self.trials, self.labels, strict=True)
        return [self._seen(trial, label) for trial, label in pairs]

    def _seen(self, trial: EmulatedTrial, label: str) -> TrialRows:
        own = self.pool, self.coordinates, trial, self.summaries[label]
        return rows_seen(*own, self.rng)

    def _fitted(self, region: Region, **options: Any) -> EmulatedLikelihood:
        """Return the likelihood of all trials."""
        shape = tuple(self.trials[0].x.shape)
        known = {"noise": self.noise, "x_shape": shape, **options}
        return emulated(self.coordinates, region, self._rows(), **known)

    def alone(self, trial: EmulatedTrial, label: str) -> EmulatedLikelihood:
        """Return the likelihood of one trial, near the belief before.

        Args:
            trial: The trial.
            label: Label of its summary.
        """
        own = self.coordinates, around(self.near), [self._seen(trial, label)]
        return emulated(*own, noise=self.noise, x_shape=tuple(trial.x.shape))

    def best_summary(
        self, trial: EmulatedTrial, *, num: int = 728, num_outer: int = 128
    ) -> str:
        """Return the summary by which a trial is expected to tell most.

        Args:
            trial: The trial.
            num: Number of parameters that are compared.
            num_outer: Number of those that outcomes are drawn at.
        """
        labels = [*self.summaries]
        if trial.label is not None or len(labels) == 1:
            return trial.label or labels[0]
        gains, z = [], np.resize(self.near, (num, self.coordinates.dim))
        for label in labels:
            rng = np.random.default_rng(derive_seed(self.seed, "gain"))
            gain = 0.0
            for part in self.alone(trial, label).parts:
                mean, spread = part.residual(z, 0)
                normal = rng.standard_normal((num_outer, mean.shape[1]))
                gain = float(mixture_gain(mean, spread, normal).mean())
            gains.append(gain)
        return labels[int(np.argmax(gains))]

    def _tails(self, stage: Stage) -> list[float]:
        """Return tail probabilities of the trials and, last, of all together."""
        c, trials = self.coordinates, self.trials
        if self.own.checked_share == 0:
            return predicted_tails(stage.learned, stage.draws, len(trials))
        num = int(self.own.checked_share * self.settings.num_histories)
        num = max(self.own.least_checked, num)
        theta, t = c.to_theta(stage.fit.draws(num, self.rng)), len(trials)
        action = torch.stack([trial.action for trial in trials]).repeat(num, 1)
        seed = derive_seed(self.seed, "fresh")
        x = self.pool.aside(theta.repeat_interleave(t, 0), action, seed=seed)
        numbers = []
        for k, trial in enumerate(trials):
            observed = trial.x.double().flatten().numpy()
            apart = trial.noisier(x[k::t], self.rng) - observed
            numbers.append(apart[:, np.isfinite(observed)])
        self.fresh = compared_with_fresh(stage.learned, c.to_z(theta), numbers)
        return self.fresh.tails

    def contradiction(self) -> Contradiction | None:
        """Return what contradicts at the draw that the last stage explains best."""
        assert self.fresh is not None
        sds = torch.from_numpy(noise_sds(self.pool, self.trials)).mean(0)
        sds = torch.where(sds > 0, sds, torch.inf)
        return compared(
            torch.stack([trial.action for trial in self.trials]),
            torch.stack([trial.x for trial in self.trials]).double(),
            lambda gap: gap.flatten(1) / sds,
            self.fresh.least,
            num_fitted=self.coordinates.dim,
        )
