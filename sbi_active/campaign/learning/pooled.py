"""Inference of a campaign whose simulations are dear: one pool serves all that asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.summaries import find_summaries
from sbi_active.arrays import Array
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.score import score_outcome
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.design.design import Design
from sbi_active.design.elimination import choose
from sbi_active.design.limits import DesignLimits
from sbi_active.identifiability.known import note_combinations
from sbi_active.inference.emulation.emulation import Emulation
from sbi_active.inference.emulation.gains import candidate_gains
from sbi_active.inference.emulation.outcomes import Summary, fitted_summaries
from sbi_active.inference.emulation.pool import EmulatedTrial, Pool
from sbi_active.inference.emulation.stages import FEW_ROWS
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import SimulatorModel, simulate
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.workers.store import SimulationBudgetError

DESIGN_SHARE = 0.4  # of a round's simulations
MOST_CANDIDATES = 48  # of a space without end
NUM_LEADERS = 6  # that the second half of a design's simulations goes to
BESIDE = 8  # rows at an executed action, beyond one a parameter, before it is used


class PooledLearner(Learner):
    """Learns from one pool of raw simulations, see :class:`.Learner`.

    Simulators that change from trial to trial are not for it.

    Raises:
        ValueError: If the method is neither "asbi" nor "nsbi", or beliefs are not
            refined.
    """

    has_networks = False
    num_looked_at = 8

    def _require_options(self) -> None:
        found = find_summaries(self.actions)
        self._choice, self._entry = (None, 0) if found is None else found
        method, refine = self.state.method, self.state.options.refine
        if method not in ("asbi", "nsbi") or not refine:
            raise ValueError(
                "expected the method 'asbi' or 'nsbi' with refine=True for "
                f"max_simulations or a SummaryAction; got {method!r} with refine="
                f"{refine}; leave them out, or pass one of these"
            )

    def simulated(self, action: Tensor) -> Tensor:
        """Return actions (..., action_dim) as the simulator gets them."""
        action = action.clone()
        if self._choice is not None:
            action[..., self._entry] = 0.0
        return action

    @cached_property
    def noise(self) -> NoiseModel | None:
        """The declared noise; None if the simulator itself is random."""
        model = self.simulator
        if self._choice is not None or not isinstance(model, SimulatorModel):
            return None
        if model.noise is None or not bool((model.noise.parameters > 0).all()):
            return None
        theta, action = self._few()
        bare, workers = model.without_noise(), self.state.options.workers
        first, second = (
            simulate(bare, theta, action, seed=k, workers=workers).x for k in (1, 2)
        )
        same = torch.equal(first.nan_to_num(0.0), second.nan_to_num(0.0))
        return model.noise if same else None

    @cached_property
    def pool(self) -> Pool:
        """All simulations for the current model."""
        simulator, workers = self.simulator, self.state.options.workers
        if self.noise is not None and isinstance(simulator, SimulatorModel):
            simulator = simulator.without_noise()
        return Pool(simulator, self.state.batches, workers)

    @property
    def _coordinates(self) -> PriorCoordinates:
        return PriorCoordinates(self.prior, np.random.default_rng(0))

    @property
    def _summaries(self) -> list[Summary]:
        return fitted_summaries(self._choice, self.pool.rows.x)

    def _near(self, seed: int, *, num: int = 400) -> Array:
        """Return coordinates of draws from the belief, shape (num, theta_dim)."""
        with forked_generators(derive_seed(seed, "reference")):
            theta = self.belief.sample(torch.Size([num]))
        return self._coordinates.to_z(theta.float())

    def _emulation(
        self, trials: Sequence[EmulatedTrial], budget: int, *key: int | str
    ) -> Emulation:
        seed = derive_seed(self.state.seed, "pooled", *key)
        return Emulation(
            *(self.prior, self._coordinates, self.pool, trials, self._summaries),
            *(self.state.options.refinement, FEW_ROWS),
            budget=budget,
            near=self._near(seed),
            noise=self.noise,
            seed=seed,
        )

    def _trial(self, trial: Trial) -> EmulatedTrial:
        assert trial.x is not None
        label = None
        if self._choice is not None and self._choice.use == "chosen":
            label = self._choice.label(trial.action[self._entry])
        return EmulatedTrial(self.simulated(trial.action), trial.x.float(), label)

    def _spent(self, before: tuple[int, int] = (0, 0)) -> tuple[int, int]:
        """Return the rows simulated since a count, and those that faults lost."""
        len(self.pool)  # which brings back its rows
        return self.state.meter.spent - before[0], self.pool.num_missing - before[1]

    def _add(self, theta: Tensor, action: Tensor, belief: Distribution) -> None:
        seed = derive_seed(self.state.seed, "pool", len(self.state.batches))
        self.pool.simulate(
            theta, action, seed=seed, log_proposal=belief.log_prob(theta).double()
        )

    def _drawn(self, num: int) -> Tensor:
        """Return parameters from the belief, shape (num, theta_dim)."""
        with forked_generators(self.state.seed, "pool", len(self.state.batches)):
            return self.belief.sample(torch.Size([num])).float()

    def _rows_left(self, part: str, index: int) -> int:
        """Return how many rows the design or the belief of a trial may take."""
        state, options = self.state, self.state.options
        share = DESIGN_SHARE if find_method(state.method).designs else 0.0
        if options.max_simulations is None:
            if part == "design":
                return int(share * options.num_simulations)
            is_new = index >= len(state.trials)
            spent = 0 if is_new else state.trials[index].num_simulations
            return max(options.num_simulations - spent, 0)
        to_go = options.planned_trials - len(state.measured)
        to_go = to_go if to_go >= 1 else 2
        left = state.meter.left
        if part == "design":
            return int(share * left / to_go)
        return int(min(left, left * (1 - share) / (to_go - share)))

    def design(self, index: int, limits: DesignLimits) -> Design:
        """Return the design of a trial, by simulations of the pool."""
        with self.state.stage(index, "design"):
            return self._design(index, limits)

    def _design(self, index: int, limits: DesignLimits) -> Design:
        seed = derive_seed(self.state.seed, "design", index)
        listed, notes = self._candidates(limits, seed)
        places, which = self.simulated(listed).unique(dim=0, return_inverse=True)
        before, allowed = self._spent(), self._rows_left("design", index)
        half = allowed // 2
        if half < 1 and not len(self.state.batches):
            raise SimulationBudgetError(
                f"expected simulations for a design; got {allowed}; raise "
                "max_simulations"
            )
        if half:
            self._spread(places, half)
        gains, valid = self._gains(places, seed)
        if allowed > half:
            best = gains.mean(2).max(1)
            leaders = np.argsort(-best, kind="stable")[:NUM_LEADERS]
            self._spread(places[torch.from_numpy(leaders.copy())], allowed - half)
            gains, valid = self._gains(places, seed)
        summary = np.zeros(len(listed), dtype=int)
        if self._choice is not None:
            summary = listed[:, self._entry].long().numpy()
        rows = torch.from_numpy(gains[which.numpy(), summary])
        shares = torch.from_numpy(valid)[which]
        eligible = limits.reached_by(shares)
        utility = (rows.mean(1) / limits.cost(listed)).masked_fill(~eligible, -math.inf)
        num, missing = self._spent(before)
        halves = rows.unflatten(1, (2, -1)).transpose(0, 1)
        return choose(
            *(limits, listed, halves, eligible, int(utility.argmax()), seed),
            probability_valid=shares,
            estimator="PooledGain",
            bound="none",
            num_simulations=num,
            num_missing=missing,
            num_samples=torch.full_like(which, rows.shape[1]),
            stopped="budget spent",
            notes=(*notes, *limits.excluded_note(eligible)),
        )

    def _candidates(
        self, limits: DesignLimits, seed: int
    ) -> tuple[Tensor, tuple[str, ...]]:
        """Return actions, some of a space without end, and notes on the others."""
        listed, notes = limits.listed()
        if listed is None:
            listed = limits.drawn(seed)[:MOST_CANDIDATES]
            if self._choice is not None:  # all summaries of the same actions
                values = self._choice.values[:, 0]
                few = listed[: max(1, MOST_CANDIDATES // len(values))]
                listed = few.repeat_interleave(len(values), 0)
                listed[:, self._entry] = values.repeat(len(few))
        return listed, notes

    def _spread(self, places: Tensor, num: int) -> None:
        """Simulate parameters from the belief where the pool is worth least."""
        worth = torch.zeros(len(places), dtype=torch.float64)
        if self.state.batches:
            weight, rows = self.pool.weights(self.belief), self.pool.rows.action
            for k, place in enumerate(places):
                own = weight[torch.isclose(rows, place, atol=1e-7).all(1)]
                if float(own.sum()) > 0:  # Kish's effective sample size
                    worth[k] = own.sum() ** 2 / own.square().sum()
        jitter = torch.rand(
            len(places),
            generator=torch.Generator().manual_seed(len(self.state.batches)),
        )
        counts = torch.zeros(len(places), dtype=torch.int64)
        for _ in range(num):
            counts[(worth + counts + 1e-3 * jitter).argmin()] += 1
        self._add(self._drawn(num), places.repeat_interleave(counts, 0), self.belief)

    def _gains(self, places: Tensor, seed: int) -> tuple[Any, Any]:
        return candidate_gains(
            self.pool,
            self._near(seed),
            places,
            self._summaries,
            self.noise,
            self._coordinates,
            seed=seed,
        )

    def _require_rows(self, trials: Sequence[EmulatedTrial], allowed: int) -> None:
        """Simulate each trial's action where the pool has hardly any row of it.

        Raises:
            SimulationBudgetError: If more are needed than are allowed.
        """
        dim, lacking = self.belief.sample(torch.Size([1])).shape[-1], []
        for trial in trials:
            here = len(self.pool.at(trial.action)) if self.state.batches else 0
            if here < dim + BESIDE:
                lacking.append((trial.action, 2 * (dim + BESIDE) - here))
        total = sum(num for _, num in lacking)
        if total > max(allowed, 0):
            state = self.state
            raise SimulationBudgetError(
                f"expected {total} simulations for the belief; got {allowed} of "
                f"max_simulations = {state.options.max_simulations}, of which "
                f"{state.meter.spent} are spent; the last belief stands. Load the "
                "campaign with a larger max_simulations"
            )
        if total:
            action = torch.cat([a.expand(num, -1) for a, num in lacking])
            self._add(self._drawn(total), action, self.belief)

    def _score(self, trial: Trial, size: int = 2_000) -> tuple[float, float]:
        """Compare a trial with ``size`` predictions of the belief and the pool."""
        state, own, before = self.state, self._trial(trial), self._spent()
        self._require_rows([own], self._rows_left("belief", trial.index))
        emulation = self._emulation([own], 0, "score", trial.index)
        near, label = emulation.near, emulation.best_summary(own)
        fitted = emulation.alone(own, label)
        rng = np.random.default_rng(derive_seed(state.seed, "score", trial.index))
        state.account(trial.index, *self._spent(before))
        z = near[rng.integers(len(near), size=size)]
        if fitted.parts:
            drawn = torch.from_numpy(fitted.parts[0].draw(z, rng))
            return score_outcome(torch.zeros(drawn.shape[1]), drawn)
        share = 1.0
        for outcome in fitted.outcomes.values():
            share = float(np.exp(outcome.log_prob(z)).mean())
        return (share if share < 0.5 else 1.0), math.log(share)

    def _inferred(self, trials: Sequence[Trial], key: int) -> Any:
        own, before = [self._trial(t) for t in trials], self._spent()
        allowed = self._rows_left("belief", trials[-1].index)
        self._require_rows(own, allowed)
        allowed -= self._spent(before)[0]
        emulation = self._emulation(own, max(allowed, 0), "belief", key)
        belief = emulation.run()
        num, missing = self._spent(before)
        known = {"num_simulations": num, "num_missing": missing}
        belief.diagnostics = belief.diagnostics.extended(**known)
        if self._choice is not None:
            for trial, label in zip(trials, emulation.labels, strict=True):
                self.state.change(trial.index, summary=label)
        note_combinations(belief, self._names, seed=self.state.seed)
        self._trainer.resume(belief, [self._observation(t) for t in trials])
        self._saved = None
        return belief

    def _examined(self, trial: Trial) -> Trial:
        return trial  # few simulations tell nothing about all of the prior


def make_learner(
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: ActionSpace,
    state: CampaignState,
    *,
    x_shape: torch.Size | None = None,
) -> Learner:
    """Return the learner that a campaign's options and actions ask for."""
    dear = state.options.max_simulations is not None
    kind = PooledLearner if dear or find_summaries(actions) is not None else Learner
    return kind(simulator, prior, actions, state, x_shape=x_shape)
