"""Choose the next action at random."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.design.design import Design, equal_errors, naming
from sbi_active.design.limits import DesignLimits, warn_missing
from sbi_active.expected import Shown, suggests
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import MissingRowsWarning, Outcome, simulate
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


class RandomDesigner(Shown):
    """Choose an action uniformly at random, the design of NSBI and NLHI.

    Args:
        actions: The action space, or a list of actions.
        num_samples: Simulations a candidate where ``min_probability_valid`` asks for
            its share of measurements; otherwise nothing is simulated.
        workers: Workers that run these simulations.
    """

    @suggests
    def __init__(
        self,
        actions: Actions,
        *,
        num_samples: int = 200,
        workers: Workers = IN_PROCESS,
    ) -> None:
        self.actions = action_space(actions)
        self.num_samples = num_samples
        self.workers = workers

    @suggests
    def select(
        self,
        model: Any = None,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        exclude: Tensor | None = None,
        min_probability_valid: float = 0.0,
        seed: int | None = None,
    ) -> Design:
        """Return a random action.

        Args:
            model: Model of which only the belief is used, see below.
            simulator: ``simulator(theta, action)``; only used, and then needed, with
                ``min_probability_valid``.
            belief: Belief over the parameters, at which candidates are simulated; None
                is ``model.belief``.
            constraint: Function of actions (n, action_dim) that says which are
                permitted, shape (n,), bool.
            exclude: Actions not to repeat, shape (t, action_dim); in a box nor others
                within a hundredth of its width.
            min_probability_valid: Candidates that give a measurement less often are
                excluded; 0 excludes none. Of a space without end, 32 actions are
                simulated.
            seed: Seed of the choice and the simulations; None draws one from torch's
                global generator.

        Returns:
            The design. Of a space without end the candidates are those drawn.

        Raises:
            ValueError: If a share of measurements is asked for without a simulator or a
                belief, or no candidate reaches it.
        """
        allowed = constraint, exclude, None, min_probability_valid
        limits = DesignLimits.of(self.actions, *allowed)
        candidates, notes = limits.listed()
        if candidates is None:
            own = None if seed is None else derive_seed(seed, "candidates")
            candidates = limits.drawn(own)[: 32 if min_probability_valid > 0 else 1]
        num = len(candidates)
        unknown = torch.full((num,), torch.nan, dtype=torch.float64)
        valid, num_samples, num_missing = unknown, 0, 0
        eligible = torch.ones(num).bool()
        if min_probability_valid > 0:
            belief = getattr(model, "belief", None) if belief is None else belief
            if simulator is None or belief is None:
                raise ValueError(
                    "expected a simulator and a belief with min_probability_valid; got "
                    f"{'no simulator' if simulator is None else 'no belief'}; pass "
                    "both, or leave min_probability_valid at 0"
                )
            seed = int(torch.randint(2**62, ())) if seed is None else seed
            num_samples = self.num_samples
            with forked_generators(seed, "theta"):
                theta = belief.sample(torch.Size([num_samples]))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MissingRowsWarning)  # they are counted
                status = simulate(
                    simulator,
                    theta.repeat(num, 1),
                    candidates.repeat_interleave(num_samples, 0),
                    seed=derive_seed(seed, "x"),
                    workers=self.workers,
                ).status.reshape(num, num_samples)
            counted = (status != Outcome.MISSING).sum(1)
            valid = (status == Outcome.OK).sum(1).double() / counted
            num_missing = num * num_samples - int(counted.sum())
            warn_missing(num_missing, num * num_samples)
            eligible = limits.reached_by(valid)
        with forked_generators(seed):
            remaining = torch.nonzero(eligible)[:, 0]
            chosen = int(remaining[int(torch.randint(len(remaining), ()))])
        return Design(
            action=candidates[chosen],
            candidates=candidates,
            expected_information_gain=unknown,
            **equal_errors(unknown),
            probability_valid=valid,
            bound="none",
            index=chosen,
            num_simulations=num * num_samples,
            **naming(self.actions),
            num_samples=torch.full((num,), num_samples).long(),
            num_missing=num_missing,
            notes=(*limits.excluded_note(eligible), *notes),
        )
