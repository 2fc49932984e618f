"""Inference of a campaign on one version of its simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.checks.misfit import error_nats, misfit
from sbi_active.campaign.checks.score import score_outcome
from sbi_active.campaign.checks.unexplained import (
    doubts,
    in_doubt,
    is_suspect,
    outlyingness,
    simulate_prior,
)
from sbi_active.campaign.learning.indexed import (
    IndexedSimulator,
    at_index,
    depends_on_index,
)
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.learning.reused import first_round
from sbi_active.campaign.learning.round_model import RoundModel
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.inference.beliefs.belief import information_gained, named
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.inference.beliefs.identifiability import note_combinations
from sbi_active.inference.beliefs.priors import require_support, require_width
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.rounds.rows import Observation, UnexplainedOutcomeError
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import Simulations, simulate
from sbi_active.simulation.simulator import square_of


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
        simulations: Simulations that the last training was on, where the design is to
            rest on them; else None.

    Raises:
        ValueError: If the prior has no support or no width, the simulator is
            deterministic, or its outcomes have no numbers.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        state: CampaignState,
        *,
        x_shape: torch.Size | None = None,
    ) -> None:
        enumerates = find_method(state.method).enumerates(state.options)
        self.simulator = simulator
        self.prior = require_support(prior, enumerates=enumerates)
        self._actions, self._state = actions, state
        self._names = getattr(simulator, "parameter_names", None)
        require_width(prior, self._names, seed=derive_seed(state.seed, "width"))
        self.restart()
        self.x_shape = self._probe() if x_shape is None else x_shape

    def restart(self) -> None:
        """Forget all trials: the belief is the prior again."""
        self._trainer = find_method(self._state.method).build(
            self.prior, self._state.options
        )
        # Asking for the network must not change the beliefs of a campaign.
        self._trainer.starts_at_network = self._trains_each_round
        self._saved: Callable[[], Distribution] | None = None
        self._end_round()
        self._stated: tuple[Distribution, list[str], Distribution] | None = None
        self.simulations: Simulations | None = None

    @property
    def _trains_each_round(self) -> bool:
        """Whether a network is trained each round, which has no discrete parameters."""
        asked = self._state.options.network == "each round"
        return asked and Enumeration.of(self.prior) is None

    @cached_property
    def _has_index(self) -> bool:
        """Whether the simulator is another one at each trial."""
        seed = derive_seed(self._state.seed, "index")
        return depends_on_index(self.simulator, self.prior, self._actions, seed=seed)

    def forget(self) -> None:
        """Have the next update compute everything again."""
        self._state.is_stale = bool(self._state.processed)

    def resume(self, belief: Callable[[], Distribution]) -> None:
        """Go on where ``state.processed`` ends.

        Args:
            belief: Function that returns the belief of that time, read when it is first
                asked for.
        """
        self._saved = belief

    @property
    def _inference(self) -> ActiveInference:
        """What learns, where the belief stands."""
        saved, self._saved = self._saved, None
        if saved is not None:
            trials = [self._observation(t) for t in self._state.explained]
            self._trainer.resume(saved(), trials)
        return self._trainer

    def _observation(self, trial: Trial) -> Observation:
        assert trial.x is not None
        place = torch.tensor([float(trial.index)]) if self._has_index else None
        action = trial.action if place is None else torch.cat([trial.action, place])
        return Observation(action, trial.x.float())

    def _end_round(self) -> None:
        self._round_ready, self._asked = False, ()

    @property
    def belief(self) -> Distribution:
        """The belief after the trials learned so far; the prior before any."""
        belief = self._inference.belief
        assert belief is not None
        return named(belief, self.simulator)

    @property
    def stated_belief(self) -> Distribution:
        """The belief, marked untrustworthy where trials are beyond all simulations."""
        belief, texts = self.belief, doubts(self._state.measured)
        if self._state.is_stale:
            texts.append(
                "SA601 a trial was corrected since: update() computes it again"
            )
        if self._stated is None or self._stated[:2] != (belief, texts):
            marked = named(in_doubt(belief, self.prior, texts), self.simulator)
            self._stated = belief, texts, marked
        return self._stated[2]

    def at(self, index: int) -> Callable[..., Any]:
        """Return the simulator of the trial of an index."""
        return at_index(self.simulator, index) if self._has_index else self.simulator

    def score(self, trial: Trial) -> None:
        """Compare a trial with what the belief before it predicts."""
        assert trial.x is not None
        state = self._state
        with state.stage(trial.index, "scoring"):
            score = score_outcome(
                trial.x,
                trial.action,
                self.at(trial.index),
                self.belief,
                num_samples=state.options.details.num_scored,
                seed=derive_seed(state.seed, "score", trial.index),
                workers=state.options.workers,
            )
        self._state.account(
            trial.index,
            score.num_simulations,
            score.num_missing,
            surprise=score.surprise,
            belief_error=error_nats(getattr(self.belief, "diagnostics", Diagnostics())),
            log_score=score.log_score,
            version=state.version.number,
        )
        self._examine(self._state.trials[trial.index])

    def _examine(self, trial: Trial) -> Trial:
        """Compare a trial that the belief did not lead to with all of the prior."""
        if not is_suspect(trial):
            return trial
        assert trial.x is not None
        state = self._state
        with state.stage(trial.index, "scoring"):
            rows = simulate_prior(
                trial,
                self.at(trial.index),
                self.prior,
                num_samples=state.options.details.num_scored,
                seed=derive_seed(state.seed, "prior", trial.index),
                workers=state.options.workers,
            )
        far = outlyingness(trial.x, rows.without_missing().x)
        lost = rows.counts["missing"]
        self._state.account(trial.index, len(rows), lost, outlyingness=far)
        return self._warned(trial.index)

    def _warned(self, index: int) -> Trial:
        trial = self._state.trials[index]
        for text in doubts([trial]):
            warn(text, stacklevel=2)
        return trial

    def learn(self, trial: Trial) -> None:
        """Bring the belief up to date with one more trial.

        A trial that nothing in the prior explains leaves the belief as it is.
        """
        if trial.is_explained:
            try:
                self._learn(trial)
                return
            except UnexplainedOutcomeError:
                self._state.account(trial.index, 0, 0, outlyingness=math.inf)
                self._warned(trial.index)
        # Its tail probability is below what any number of simulations resolves.
        self._state.account(trial.index, 0, 0, information_gained=0.0, misfit=0.0)

    def _learn(self, trial: Trial) -> None:
        assert trial.x is not None
        state = self._state
        seed, options = state.seed, state.options
        every_round = self._trains_each_round
        if not self._has_index and (every_round or not options.refine):
            self.trained(trial.index)
            serves = self._inference.network_serves if options.refine else ("belief",)
            self.note(trial.index, *serves)
        before = self.belief
        with state.stage(trial.index, "update"):
            if self._has_index:
                earlier = [t for t in state.explained if t.index != trial.index]
                belief = self._infer([*earlier, trial], trial.index)
            else:
                with forked_generators(seed, "update", trial.index):
                    belief = self._inference.update(
                        trial.x,
                        action=trial.action,
                        simulator=self.simulator if options.refine else None,
                        refinement=replace(options.refinement, workers=options.workers),
                        seed=derive_seed(seed, "refine", trial.index),
                    )
                note_combinations(belief, self._names, seed=seed)
            gained = information_gained(
                belief, before, seed=derive_seed(seed, "gain", trial.index)
            )
        self._end_round()
        figures = belief.diagnostics
        self._state.account(
            trial.index,
            figures.num_simulations,
            figures.num_missing,
            information_gained=gained,
            misfit=misfit(figures),
        )

    def infer(self, trials: Sequence[Trial]) -> float | None:
        """Replace the belief by that of these trials, from scratch.

        Returns:
            Its misfit to them, as in :class:`.ModelVersion`.
        """
        self.restart()
        explained = [t for t in map(self._examine, trials) if t.is_explained]
        if not explained:
            return 0.0 if trials else None
        found = misfit(self._infer(explained, len(trials)).diagnostics)
        return found if len(explained) == len(trials) else 0.0

    def _infer(self, trials: Sequence[Trial], key: int) -> Any:
        simulator: Any = self.simulator
        if self._has_index:
            simulator = IndexedSimulator(simulator)
        state = self._state
        options = state.options
        belief = self._inference.update_all(
            [self._observation(trial) for trial in trials],
            simulator,
            refinement=replace(options.refinement, workers=options.workers),
            seed=derive_seed(state.seed, "infer", state.version.number, key),
        )
        note_combinations(belief, self._names, seed=state.seed)
        return belief

    def note(self, index: int, *by: str) -> None:
        """Write down what asked this round's network, see :class:`.Trial`."""
        self._asked = (*self._asked, *by)
        if index < len(self._state.trials):
            earlier = self._state.trials[index].network_used_by
            asked = tuple(dict.fromkeys((*earlier, *self._asked)))
            self._state.change(index, network_used_by=asked)

    def model(self, index: int) -> RoundModel:
        """Return the model that a design asks, trained now or on demand.

        Args:
            index: Index of the trial that is designed.
        """
        if Enumeration.of(self.prior) is not None:
            return RoundModel(None)
        options = self._state.options
        can_wait = self._inference.amortized and options.details.design_on == "fresh"
        is_due = self._trains_each_round or not can_wait
        return RoundModel(
            lambda: self.trained(index), self.trained(index) if is_due else None
        )

    def posterior(self, index: int) -> ActionPosterior:
        """Return the model of this round where it is a posterior.

        Args:
            index: Index of the trial that the round is for.

        Raises:
            ValueError: If it is another one.
        """
        model = self.trained(index)
        if not isinstance(model, ActionPosterior):
            raise ValueError(
                "expected the method 'asbi' or 'nsbi', whose network is a posterior; "
                f"got {self._state.method!r}; use the belief"
            )
        self.note(index, "posterior")
        return model

    def trained(self, index: int) -> Any:
        """Return the posterior trained under the current belief, training if needed.

        Args:
            index: Index of the trial that the work is for.
        """
        state = self._state
        if not self._round_ready:
            seed, options = state.seed, state.options
            # Not the index: a trial that was missing, or taken out, trains nothing.
            key = len(state.explained)
            with state.stage(index, "simulation"):
                with forked_generators(seed, "theta", key):
                    theta = self.belief.sample(torch.Size([options.num_simulations]))
                action = self._actions.sample(
                    (options.num_simulations,), seed=derive_seed(seed, "action", key)
                )
                drawn = theta
                theta, action = self._inference.arrange(theta, action)
                x_seed, workers = derive_seed(seed, "x", key), options.workers
                if key == 0 and theta is drawn and not self._has_index:
                    known, num, num_missing = first_round(
                        self.simulator,
                        self.belief,
                        theta,
                        action,
                        actions=self._actions,
                        num_earlier=state.num_earlier,
                        seed=x_seed,
                        workers=workers,
                    )
                else:
                    rows = simulate(
                        self.at(index), theta, action, seed=x_seed, workers=workers
                    )
                    known = rows.without_missing()
                    num, num_missing = len(rows), rows.counts["missing"]
                if options.details.design_on == "training":
                    self.simulations = known
            with state.stage(index, "training"):
                self._inference.append_simulations(
                    known.theta, known.x, action=known.action, belief=self.belief
                )
                with forked_generators(seed, "train", key):
                    self._inference.train()
            self._state.account(index, num, num_missing)
            self._round_ready = True
        return self._inference.build_posterior()

    def _probe(self) -> torch.Size:
        """Return x_shape from a few simulations, which must differ by seed."""
        seed = self._state.seed
        with forked_generators(seed, "probe"):
            theta: Tensor = self.prior.sample(torch.Size([16]))
        action = self._actions.sample((16,), seed=derive_seed(seed, "probe"))
        options: dict[str, Any] = {"seed": derive_seed(seed, "probe", 1)}
        options["workers"] = self._state.options.workers
        x = simulate(self.simulator, theta, action, check_noise=True, **options).x
        if square_of(x, None) is not None:  # by chance, or is it one for each row?
            fewer = simulate(self.simulator, theta[1:], action[1:], **options)
            square_of(fewer.x, len(x))
        return x.shape[1:]
