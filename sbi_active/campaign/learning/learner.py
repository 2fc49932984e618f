"""Inference of a campaign on one version of its simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from attrs import evolve
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.health import (
    doubts,
    error_nats,
    is_suspect,
    misfit,
    outlyingness,
)
from sbi_active.campaign.learning.indexed import (
    IndexedSimulator,
    at_index,
    depends_on_index,
)
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.learning.rounds import Round
from sbi_active.campaign.score import score_outcome
from sbi_active.campaign.state import UNSCORED, CampaignState, Trial
from sbi_active.expected import require
from sbi_active.identifiability.known import note_combinations
from sbi_active.inference.beliefs.belief import information_gained, named
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.inference.beliefs.priors import require_support, require_width
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.rounds.rows import Observation, UnexplainedOutcomeError
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import Simulations, simulate
from sbi_active.simulation.workers.store import SimulationBudgetError


class Learner:
    """Trains, scores and updates for a campaign, and writes it to the campaign's state.

    Args:
        simulator: ``simulator(theta, action)``. One with a ``next_index`` that matters
            is simulated at the index of each trial.
        prior: Prior of its parameters.
        actions: Action space of the campaign.
        state: State of the campaign.
        x_shape: Shape of an outcome; None finds it by a few simulations.

    Attributes:
        x_shape: Shape of an outcome.
        actions: Action space of the campaign.
        state: State of the campaign.
        round: The current round, with its network.

    Raises:
        ValueError: If the prior has no support or no width, the simulator is
            deterministic, or its outcomes have no numbers.
    """

    has_networks = True
    num_looked_at = 16  # simulations that show what the simulator is

    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        state: CampaignState,
        *,
        x_shape: torch.Size | None = None,
    ) -> None:
        self.simulator, self.actions, self.state = simulator, actions, state
        self._require_options()
        enumerates = find_method(state.method).enumerates(state.options)
        self.prior = require_support(prior, enumerates=enumerates)
        self._names = getattr(simulator, "parameter_names", None)
        require_width(prior, self._names, seed=derive_seed(state.seed, "width"))
        self.restart()
        self.x_shape = self._probe() if x_shape is None else x_shape

    def _require_options(self) -> None:
        """Raise if this is no way to learn for the campaign's options."""

    def restart(self) -> None:
        """Forget all trials: the belief is the prior again."""
        self._trainer = find_method(self.state.method).build(
            self.prior, self.state.options
        )
        # Asking for the network must not change the beliefs of a campaign.
        self._trainer.starts_at_network = self.trains_each_round
        self._saved: Callable[[], Distribution] | None = None
        self.round = Round(self)

    @property
    def trains_each_round(self) -> bool:
        """Whether a network is trained each round, which has no discrete parameters."""
        asked = self.state.options.network == "each round"
        return asked and Enumeration.of(self.prior) is None

    @cached_property
    def has_index(self) -> bool:
        """Whether the simulator is another one at each trial."""
        seed = derive_seed(self.state.seed, "index")
        return depends_on_index(self.simulator, self.prior, self.actions, seed=seed)

    @property
    def infers_anew(self) -> bool:
        """Whether a belief is that of all trials at once, and not of one more."""
        return not self.has_networks or self.has_index

    def resume(self, belief: Callable[[], Distribution]) -> None:
        """Go on where ``state.processed`` ends.

        Args:
            belief: Function that returns the belief of that time, read when it is first
                asked for.
        """
        self._saved = belief

    @property
    def inference(self) -> ActiveInference:
        """What learns, where the belief stands."""
        saved, self._saved = self._saved, None
        if saved is not None:
            trials = [self._observation(t) for t in self.state.explained]
            self._trainer.resume(saved(), trials)
        return self._trainer

    def _observation(self, trial: Trial) -> Observation:
        assert trial.x is not None
        place = torch.tensor([float(trial.index)]) if self.has_index else None
        action = trial.action if place is None else torch.cat([trial.action, place])
        return Observation(action, trial.x.float())

    @property
    def belief(self) -> Distribution:
        """The belief after the trials learned so far; the prior before any."""
        belief = self.inference.belief
        assert belief is not None
        return named(belief, self.simulator)

    def at(self, index: int) -> Callable[..., Any]:
        """Return the simulator of the trial of an index."""
        return at_index(self.simulator, index) if self.has_index else self.simulator

    def takes(self, trial: Trial) -> bool:
        """Score a trial and learn from it; return False if simulations ran out.

        The trial then stays recorded and the belief as it is, as it does for a trial
        that nothing in the prior explains.
        """
        state = self.state
        try:
            if trial.version != state.version.number:
                trial = self._scored(trial)
            self._learn(trial)
        except SimulationBudgetError as error:
            state.change(trial.index, **UNSCORED)
            warn(
                f"SA602 trial {trial.index} is recorded and not in the belief: {error}"
            )
            return False
        return True

    def _scored(self, trial: Trial) -> Trial:
        """Compare a trial with what the belief before it predicts."""
        state, index = self.state, trial.index
        diagnostics = getattr(self.belief, "diagnostics", Diagnostics())
        with state.stage(index, "scoring"):
            surprise, log_score = self._score(trial)
        state.change(
            index,
            surprise=surprise,
            log_score=log_score,
            belief_error=error_nats(diagnostics),
            version=state.version.number,
        )
        return self._examined(state.trials[index])

    def _score(self, trial: Trial, size: int = 4_000_000) -> tuple[float, float]:
        """Return the surprise and the log score of a trial.

        Args:
            trial: The trial.
            size: Numbers that are compared at most, in 400 simulations or more:
                their products cost more than their simulation.
        """
        assert trial.x is not None
        affordable = max(400, size // max(trial.x.numel(), 1))
        drawn = self._simulated(self.belief, trial, "score", affordable)
        return score_outcome(trial.x, drawn)

    def _simulated(
        self, source: Distribution, trial: Trial, purpose: str, most: float = math.inf
    ) -> Tensor:
        """Return outcomes of a trial's action with parameters from a distribution."""
        options, index = self.state.options, trial.index
        num = int(min(options.details.num_scored, most))
        seed = derive_seed(self.state.seed, purpose, index)
        with forked_generators(seed, "theta"):
            theta = source.sample(torch.Size([num]))
        rows = self.outcomes(trial, theta, derive_seed(seed, "x"))
        self.state.account(index, num, rows.counts["missing"])
        return rows.without_missing().x

    def outcomes(self, trial: Trial, theta: Tensor, seed: int) -> Simulations:
        """Return outcomes of a trial's action at parameters (n, theta_dim)."""
        action = self.simulated(trial.action).expand(len(theta), -1)
        how: Any = {"seed": seed, "workers": self.state.options.workers}
        return simulate(self.at(trial.index), theta, action, **how)

    def _examined(self, trial: Trial) -> Trial:
        """Compare a trial that the belief did not lead to with all of the prior."""
        if not is_suspect(trial):
            return trial
        assert trial.x is not None
        with self.state.stage(trial.index, "scoring"):
            drawn = self._simulated(self.prior, trial, "prior")
        return self._found_far(trial.index, outlyingness(trial.x, drawn))

    def _found_far(self, index: int, ranges: float) -> Trial:
        """Note how far beyond all simulations a trial is, and warn of one that is."""
        self.state.change(index, outlyingness=ranges)
        trial = self.state.trials[index]
        for text in doubts([trial]):
            warn(text)
        return trial

    def _learn(self, trial: Trial) -> None:
        """Bring the belief up to date with one more trial."""
        # A tail probability below what any number of simulations resolves.
        found: dict[str, Any] = {"information_gained": 0.0, "misfit": 0.0}
        if trial.is_explained:
            try:
                found = self._update(trial)
            except UnexplainedOutcomeError:
                self._found_far(trial.index, math.inf)
        self.state.change(trial.index, **found)

    def _update(self, trial: Trial) -> dict[str, Any]:
        """Learn from a trial, and return what that changed of its entries."""
        state, index = self.state, trial.index
        self._prepare(index)
        before = self.belief
        with state.stage(index, "update"):
            belief = self._updated(trial)
            seed = derive_seed(state.seed, "gain", index)
            gained = information_gained(belief, before, seed=seed)
        self.round, figures = Round(self), belief.diagnostics
        state.account(index, figures.num_simulations, figures.num_missing)
        return {"information_gained": gained, "misfit": misfit(figures)}

    def _prepare(self, index: int) -> None:
        """Train the network that the update of a trial uses."""
        refine = self.state.options.refine
        if not self.infers_anew and (self.trains_each_round or not refine):
            self.round.trained(index)

    def _updated(self, trial: Trial) -> Any:
        """Return the belief with one more trial."""
        state = self.state
        if self.infers_anew:
            earlier = [t for t in state.explained if t.index != trial.index]
            return self._inferred([*earlier, trial], trial.index)
        with forked_generators(state.seed, "update", trial.index):
            assert trial.x is not None
            belief: Any = self.inference.update(
                trial.x,
                action=trial.action,
                simulator=self.simulator if state.options.refine else None,
                refinement=self._refinement,
                seed=derive_seed(state.seed, "refine", trial.index),
            )
        note_combinations(belief, self._names, seed=state.seed)
        return belief

    def infer(self, trials: Sequence[Trial]) -> float | None:
        """Replace the belief by that of these trials, from scratch.

        Returns:
            Its misfit to them, as in :class:`.ModelVersion`.
        """
        self.restart()
        explained = [t for t in map(self._examined, trials) if t.is_explained]
        if not explained:
            return 0.0 if trials else None
        found = misfit(self._inferred(explained, len(trials)).diagnostics)
        return found if len(explained) == len(trials) else 0.0

    def _inferred(self, trials: Sequence[Trial], key: int) -> Any:
        """Return the belief of trials, from scratch."""
        state, simulator = self.state, self.simulator
        belief: Any = self.inference.update_all(
            [self._observation(trial) for trial in trials],
            IndexedSimulator(simulator) if self.has_index else simulator,
            refinement=self._refinement,
            seed=derive_seed(state.seed, "infer", state.version.number, key),
        )
        note_combinations(belief, self._names, seed=state.seed)
        return belief

    @property
    def _refinement(self) -> RefinementOptions:
        options = self.state.options
        return evolve(options.refinement, workers=options.workers)

    def simulated(self, action: Tensor) -> Tensor:
        """Return actions (..., action_dim) as the simulator gets them."""
        return action

    def _few(self) -> tuple[Tensor, Tensor]:
        """Return parameters and actions at which to look at the simulator."""
        seed, num = self.state.seed, self.num_looked_at
        with forked_generators(seed, "probe"):
            theta: Tensor = self.prior.sample(torch.Size([num]))
        action = self.actions.sample((num,), seed=derive_seed(seed, "probe"))
        return theta, self.simulated(action)

    def _probe(self) -> torch.Size:
        """Return x_shape from a few simulations, which must differ by seed."""
        theta, action = self._few()
        workers = self.state.options.workers
        options: Any = {"seed": derive_seed(self.state.seed, "probe", 1)}
        options |= {"workers": workers}
        x = simulate(self.simulator, theta, action, check_noise=True, **options).x
        if x.shape == (len(x), len(x)):  # by chance, or is it one for each row?
            fewer = simulate(self.simulator, theta[1:], action[1:], **options)
            require(
                fewer.x.shape[1:] == x.shape[1:],
                "x of one shape a row",
                f"{tuple(fewer.x.shape)} and {tuple(x.shape)}, as where theta[:, 0] of "
                "shape (n,) meets action of shape (n, 1)",
                "index both alike, as in theta[:, :1]",
            )
        return x.shape[1:]
