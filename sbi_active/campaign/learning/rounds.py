"""What a round trains on, and the network that it trains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from sbi_active.campaign.isolation import isolated
from sbi_active.expected import require
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.outcomes import Simulations
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.store import find_store

DENSITIES = ("log_posterior", "log_likelihood", "log_ratio")


class Round:
    """A round of a campaign: its simulations and its network.

    Args:
        learner: Learner whose belief the round begins at.
    """

    def __init__(self, learner: Any) -> None:
        self._learner = learner
        self._is_trained = False

    def model(self, index: int) -> RoundModel:
        """Return the model that a design asks, trained now or on demand.

        Args:
            index: Index of the trial that is designed.
        """
        learner = self._learner
        if Enumeration.of(learner.prior) is not None:
            return RoundModel(None)
        model = RoundModel(lambda: self.trained(index))
        if learner.trains_each_round or not learner.inference.amortized:
            model.train()
        return model

    def posterior(self, index: int) -> ActionPosterior:
        """Return the model of this round where it is a posterior.

        Args:
            index: Index of the trial that the round is for.

        Raises:
            ValueError: If it is another one, or none is trained.
        """
        require(
            self._learner.has_networks,
            "a campaign that trains networks",
            "max_simulations or a SummaryAction, with which none is trained",
            "use the belief",
        )
        model = self.trained(index)
        expected = "the method 'asbi' or 'nsbi', whose network is a posterior"
        is_posterior = isinstance(model, ActionPosterior)
        require(is_posterior, expected, self._learner.state.method, "use the belief")
        return model

    def trained(self, index: int) -> Any:
        """Return the model trained under the current belief, training if needed.

        Args:
            index: Index of the trial that the work is for.
        """
        learner, state = self._learner, self._learner.state
        if not self._is_trained:
            with state.stage(index, "simulation"):
                rows = self._rows(index)
                learner.inference.append_simulations(
                    rows.theta, rows.x, action=rows.action, belief=learner.belief
                )
                del rows  # of which training has its own
            own = forked_generators(state.seed, "train", len(state.explained))
            with state.stage(index, "training"), own:
                learner.inference.train()
            self._is_trained = True
        return learner.inference.build_posterior()

    def _rows(self, index: int) -> Simulations:
        """Simulate the round: parameters from the belief, actions from the space.

        The rows of a first round are stored with their density under the prior.
        """
        learner, state = self._learner, self._learner.state
        # Not the index: a trial that was missing, or taken out, trains nothing.
        seed, num, key = state.seed, state.options.num_simulations, len(state.explained)
        with forked_generators(seed, "theta", key):
            drawn = learner.belief.sample(torch.Size([num]))
        action = learner.actions.sample((num,), seed=derive_seed(seed, "action", key))
        theta, action = learner.inference.arrange(drawn, action)
        simulator, own = learner.at(index), derive_seed(seed, "x", key)
        store = None
        if key == 0 and theta is drawn and not learner.has_index:
            store = find_store(simulator)
            if isinstance(store, Bank):  # so that :func:`.reuse` can weight the rows
                store = store.drawn_from(learner.belief)
        workers = state.options.workers
        rows = simulate(
            simulator, theta, action, seed=own, workers=workers, store=store
        )
        state.account(index, len(rows), rows.counts["missing"])
        return rows.without_missing()


class RoundModel:
    """The model of a round, as a designer takes it.

    It is trained once something asks for one of its densities.

    Args:
        trained: Function that returns the model, trained in this call if needed; None
            if none can be, as of discrete parameters.
    """

    def __init__(self, trained: Callable[[], Any] | None) -> None:
        self._trained, self._model = trained, None

    def train(self) -> None:
        """Train the model, unless that has been done."""
        if self._model is None and self._trained is not None:
            # Estimates are made without gradients, training is not.
            self._model = isolated(self._trained)()

    def __getattr__(self, name: str) -> Any:
        if self._trained is None:
            raise AttributeError(name)
        if name in DENSITIES:
            self.train()
        return getattr(self._model, name)
