"""The interface of every active inference method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import finite
from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import (
    Belief,
    ChainedBelief,
    compare,
    named,
)
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.declared.refining import SimulatedBelief
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.refining import refine
from sbi_active.inference.engine.learned import LearnedBelief
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.inference.rounds.rows import Observation, UnexplainedOutcomeError
from sbi_active.messages import warn
from sbi_active.seeding import forked_generators, kept_generators
from sbi_active.simulation.outcomes import Simulations
from sbi_active.support import parameter_dim, within_support


def is_finite_somewhere(
    prior: Distribution, log_density: Callable[[Tensor], Tensor], *, num: int = 64
) -> bool:
    """Return whether a learned density is finite: float32 has no squares of 1e20.

    Args:
        prior: Prior of which draws are tried.
        log_density: Log density at parameters, (n, theta_dim) -> (n,).
        num: Number of draws.
    """
    with forked_generators(0), torch.no_grad():
        theta = prior.sample(torch.Size([num])).float()
        return bool(log_density(theta).isfinite().any())


class ActiveInference(ABC):
    r"""A method that learns from simulations and updates a belief by real trials.

    In a round, rows drawn under the current belief go to ``append_simulations(theta, x,
    action=, belief=)``, ``train()`` learns from them, ``build_posterior()`` gives the
    model that actions are designed with, and :meth:`update` takes the real trial. The
    model has ``log_posterior``, ``log_likelihood`` or ``log_ratio``, which is all that
    a designer asks for.

    A method implements these three and :meth:`_learned`, the belief by its network
    alone. With a simulator the belief of every method is "refined": the posterior of
    all trials so far given the original prior, from simulations where it is plausible
    (:func:`.refine`).

    Attributes:
        trials: Real trials so far, in order.
        amortized: Whether the model knows all parameters; otherwise only those that
            ``model.belief`` draws.
        starts_at_network: Whether a refinement begins at this round's network, where
            there is one.
    """

    trials: list[Observation]
    amortized: ClassVar[bool] = True
    starts_at_network: bool = True

    append_simulations: Callable[..., Any]
    train: Callable[..., Any]
    build_posterior: Callable[..., Any]

    _prior: Distribution | None
    _belief: Distribution | None = None
    _round_belief: Distribution | None = None
    _action_dim: int | None = None
    _outcome_shape: torch.Size | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.trials)} trials)"

    @property
    def belief(self) -> Distribution | None:
        """The current belief over parameters; the prior before any trial."""
        return self._prior if self._belief is None else self._belief

    def arrange(self, theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows to simulate in a round, made of independent draws.

        Args:
            theta: Draws from the belief, shape (n, theta_dim).
            action: Draws from the action space, shape (n, action_dim).

        Returns:
            At most n rows of both; most methods take the draws as they are.
        """
        return theta, action

    def update(
        self,
        x_o: Tensor,
        *,
        action: Tensor,
        simulator: Callable[..., Any] | None = None,
        refinement: RefinementOptions | None = None,
        seed: int | None = None,
    ) -> Belief:
        """Return the belief after a real trial, and make it the current one.

        Args:
            x_o: The observed outcome, shape x_shape or (1, *x_shape); NaN where there
                was no measurement.
            action: The executed action, shape (action_dim,) or (1, action_dim); it need
                not be one of the actions that were asked for.
            simulator: If given, ``simulator(theta, action)`` to refine the belief
                with; otherwise use this round's network.
            refinement: Budget of the refinement; None is ``RefinementOptions()``.
            seed: Seed of all draws in the refinement; None draws one from torch's
                global generator.

        Returns:
            The belief; ``belief.label`` says how it was made.

        Raises:
            RuntimeError: If there is no simulator and nothing was learned since the
                belief last changed.
            ValueError: If shapes do not fit.
        """
        trials = (*self.trials, self._observation(x_o, action))
        return self._conclude(trials, simulator, refinement, seed)

    def update_all(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any],
        *,
        refinement: RefinementOptions | None = None,
        seed: int | None = None,
    ) -> Belief:
        """Return the refined belief of these trials alone, computed from scratch.

        Args:
            trials: Trials that replace the history.
            simulator: Simulator to refine the belief with, as in :meth:`update`.
            refinement: Budget of the refinement.
            seed: Seed of all draws; None draws one from torch's global generator.

        Raises:
            ValueError: If there is no trial.
        """
        require(len(trials) > 0, "at least one trial", "none", "pass trials")
        return self._conclude(trials, simulator, refinement, seed, afresh=True)

    def resume(self, belief: Distribution, trials: Sequence[Observation]) -> None:
        """Go on from a belief that was inferred before.

        Args:
            belief: Belief after the trials.
            trials: Trials that replace the history.
        """
        self._belief, self.trials = belief, [*trials]
        self._forget_round()

    @abstractmethod
    def _learned(
        self,
        trials: Sequence[Observation],
        settings: RefinementOptions,
        seed: int | None,
        *,
        required: bool,
    ) -> Belief | None:
        """Return the belief by what this round learned, and change nothing.

        It is None if nothing was learned and no belief is required, or where a
        refinement would not begin there.
        """

    def _inferred(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any] | None,
        settings: RefinementOptions,
        seed: int | None,
        *,
        afresh: bool,
    ) -> Belief:
        """Return the belief after trials, and change nothing.

        Afresh it begins at the prior, without the belief before and the network.
        """
        learned, required = None, simulator is None
        if required or (self.starts_at_network and not afresh):
            with nullcontext() if seed is None else kept_generators():
                learned = self._learned(trials, settings, seed, required=required)
        if simulator is None:
            assert learned is not None
            return learned
        previous = None if afresh else self._belief
        # A belief of a network can be wrong; the refined one before the trial holds the
        # posterior, if only it is wide enough.
        start = [] if learned is None else [learned]
        if isinstance(previous, LearnedBelief | SimulatedBelief):
            start.append(previous)
        belief = refine(
            simulator,
            require_support(self._prior, enumerates=True),
            torch.stack([t.action for t in trials]),
            torch.stack([t.x for t in trials]),
            start=start,
            past=getattr(previous, "histories", None),
            settings=settings,
            seed=int(torch.randint(2**62, ())) if seed is None else seed,
        )
        if isinstance(learned, ChainedBelief):
            compare(belief, learned)
        return belief

    def _conclude(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any] | None,
        refinement: RefinementOptions | None,
        seed: int | None,
        *,
        afresh: bool = False,
    ) -> Belief:
        """End the round with a belief: its network belongs to the one before."""
        settings = refinement or RefinementOptions()
        belief = self._inferred(trials, simulator, settings, seed, afresh=afresh)
        named(belief, simulator)
        self._belief, self.trials = belief, [*trials]
        self._forget_round()
        return belief

    @abstractmethod
    def _forget_round(self) -> None:
        """Have the next update do without what was learned in this round."""

    def _new_rows(
        self,
        theta: Tensor,
        x: Tensor,
        action: Tensor,
        belief: Distribution | None,
        *,
        exclude_invalid: bool,
    ) -> tuple[Simulations, bool]:
        """Return checked rows of a belief in float32, and whether a round begins.

        Outcomes may be gigabytes: who keeps them makes a copy. That no row has a
        measurement is plausible under a belief from trials that had none.
        """
        prior = require_support(self._prior)
        theta = torch.as_tensor(theta, dtype=torch.float32).clone()
        x = torch.as_tensor(x)
        x = x[:, None] if x.ndim == 1 else x
        dim = parameter_dim(prior)
        require(
            theta.ndim == 2 and theta.shape[1] == dim and len(x) == len(theta),
            f"theta (n, {dim}) and x (n, ...) with as many rows",
            f"{tuple(theta.shape)} and {tuple(x.shape)}",
            "give one row a simulation",
        )
        outside = ~within_support(prior, theta)
        if bool(outside.any()):
            row = int(outside.nonzero()[0])
            raise ValueError(
                "expected theta within the prior's support; got "
                f"{int(outside.sum())} of {len(theta)} rows outside, the first "
                f"{theta[row].tolist()} in row {row}; sample theta from the belief"
            )
        x = outcome_rows(x, self._outcome_shape or x.shape[1:], copy=False)
        action = action_rows(action, self._action_dim, num_rows=len(theta))
        rows = Simulations(theta, action, x)
        present = finite(x.flatten(1))
        invalid = ~(present.all(-1) if exclude_invalid else present.any(-1))
        if bool(invalid.all()) and (exclude_invalid or not self.trials):
            raise UnexplainedOutcomeError(
                f"expected at least one simulation with a measurement; got {len(x)} of "
                f"{len(x)} invalid (NaN or inf); check the simulator at theta = "
                f"{theta[0].tolist()}, action = {action[0].tolist()}"
            )
        if exclude_invalid and bool(invalid.any()):
            warn(
                f"SA302 dropping {int(invalid.sum())} of {len(x)} simulations without "
                "a measurement: information gain is then biased towards actions that "
                "fail. The default MixtureDensity network keeps them."
            )
            rows = rows.at(~invalid)
        self._outcome_shape, self._action_dim = rows.x.shape[1:], rows.action.shape[1]
        belief = self.belief if belief is None else belief
        is_new = belief is not self._round_belief
        self._belief = self._round_belief = belief
        return rows, is_new

    def _observation(self, x_o: Tensor, action: Tensor) -> Observation:
        """Return the checked trial."""
        x = torch.as_tensor(x_o)
        shape = self._outcome_shape
        if shape is None:  # no simulations yet: the first trial says
            shape = self.trials[0].x.shape if self.trials else x.shape or (1,)
        rows = outcome_rows(x, shape)
        advice = "update with one trial at a time"
        require(len(rows) == 1, "one outcome", f"{len(rows)} rows", advice)
        executed = action_rows(action, self._action_dim, num_rows=1)[0]
        return Observation(executed, rows[0])
