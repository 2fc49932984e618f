"""What a round trains on, and the network that it trains."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from sbi_active.campaign.isolation import isolated
from sbi_active.expected import require
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.outcomes import Simulations
from sbi_active.simulation.reweighting import FEW, reuse
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.store import find_store

LOGGER = logging.getLogger("sbi_active")
DENSITIES = ("log_posterior", "log_likelihood", "log_ratio")


class Round:
    """A round of a campaign: its simulations, its network and who uses it.

    Args:
        learner: Learner whose belief the round begins at.
    """

    def __init__(self, learner: Any) -> None:
        self._learner = learner
        self._is_trained = False
        self._users: tuple[str, ...] = ()

    def note(self, index: int, *users: str) -> None:
        """Write down who uses this round's network, see :class:`.Trial`."""
        state = self._learner.state
        self._users = (*self._users, *users)
        if index < len(state.trials):
            all_users = (*state.trials[index].network_used_by, *self._users)
            state.change(index, network_used_by=(*dict.fromkeys(all_users),))

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
        self.note(index, "posterior")
        return model

    def trained(self, index: int) -> Any:
        """Return the model trained under the current belief, training if needed.

        Args:
            index: Index of the trial that the work is for.
        """
        learner, state = self._learner, self._learner.state
        if not self._is_trained:
            with state.stage(index, "simulation"):
                rows, num_simulations, num_missing = self._rows(index)
                learner.inference.append_simulations(
                    rows.theta, rows.x, action=rows.action, belief=learner.belief
                )
            own = forked_generators(state.seed, "train", len(state.explained))
            with state.stage(index, "training"), own:
                learner.inference.train()
            state.account(index, num_simulations, num_missing)
            self._is_trained = True
        return learner.inference.build_posterior()

    def _rows(self, index: int) -> tuple[Simulations, int, int]:
        """Simulate the round: parameters from the belief, actions from the space.

        A first round begins with what earlier campaigns left in a bank, and stores the
        others with their density under the prior, by which the next campaign weights
        them.

        Returns:
            Rows without the missing, how many were simulated, and how many of these
            are missing.
        """
        learner, state = self._learner, self._learner.state
        # Not the index: a trial that was missing, or taken out, trains nothing.
        seed, num, key = state.seed, state.options.num_simulations, len(state.explained)
        with forked_generators(seed, "theta", key):
            drawn = learner.belief.sample(torch.Size([num]))
        action = learner.actions.sample((num,), seed=derive_seed(seed, "action", key))
        theta, action = learner.inference.arrange(drawn, action)
        simulator, own = learner.at(index), derive_seed(seed, "x", key)
        store = earlier = None
        if key == 0 and theta is drawn and not learner.has_index:
            store = find_store(simulator)
            earlier = self._earlier(store, len(theta), own)
            if isinstance(store, Bank):
                store = store.drawn_from(learner.belief, label="prior")
        first = 0 if earlier is None else len(earlier)
        if earlier is not None and first == len(theta):
            return earlier, 0, 0
        rows = simulate(
            simulator,
            theta[first:],
            action[first:],
            seed=own,
            workers=state.options.workers,
            store=store,
        )
        known = rows.without_missing()
        if earlier is not None:
            pairs = [(earlier.theta, known.theta), (earlier.action, known.action)]
            x = torch.cat([earlier.x, known.x])
            known = Simulations(*map(torch.cat, pairs), x=x)
        return known, len(rows), rows.counts["missing"]

    def _earlier(self, bank: Any, num_rows: int, seed: int) -> Simulations | None:
        """Return as many rows of earlier campaigns as they are worth; None if few.

        Rows that this campaign stored itself must not count when it begins again, nor
        do those of other actions.
        """
        learner, state = self._learner, self._learner.state
        if not (isinstance(bank, Bank) and state.num_earlier):
            return None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # their number is said below
                found = reuse(bank, learner.belief)
        except ValueError:  # none whose proposal is known
            return None
        permitted = learner.actions.contains(bank.read(found.rows).action)
        weights = found.weights * (permitted & (found.rows < state.num_earlier))
        if not weights.sum() > 0:
            return None
        found = replace(found, weights=weights / weights.sum())
        worth = found.effective_sample_size
        used = min(num_rows, int(worth))
        LOGGER.info(
            "first round: %d of %d rows are read from %s, whose %d earlier rows are "
            "worth %.0f draws from the prior",
            *(used if used >= FEW else 0, num_rows, bank.path),
            *(int((weights > 0).sum()), worth),
        )
        if used < FEW:
            return None
        return found.resample(used, seed=derive_seed(seed, "reused"))


class RoundModel:
    """The model of a round, as a designer takes it.

    It is trained once something asks for one of its densities.

    Args:
        trained: Function that returns the model, trained in this call if needed; None
            if none can be, as of discrete parameters.

    Attributes:
        was_asked: Whether something did.
    """

    def __init__(self, trained: Callable[[], Any] | None) -> None:
        self._trained, self._model = trained, None
        self.was_asked = False

    @property
    def is_trained(self) -> bool:
        """Whether the model is there without any work."""
        return self._model is not None

    def train(self) -> None:
        """Train the model, unless that has been done."""
        if self._model is None and self._trained is not None:
            # Estimates are made without gradients, training is not.
            self._model = isolated(self._trained)()

    def __getattr__(self, name: str) -> Any:
        if self._trained is None:
            raise AttributeError(name)
        is_density = name in DENSITIES
        if is_density:
            self.train()
        found = getattr(self._model, name)
        self.was_asked |= is_density
        return found
