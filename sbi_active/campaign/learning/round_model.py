"""The network of a round, trained once something asks for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sbi_active.campaign.isolation import isolated

DENSITIES = ("log_posterior", "log_likelihood", "log_ratio")


class RoundModel:
    """The model of a round, as a designer takes it.

    Args:
        train: Function that returns the model, trained in this call if needed; None
            if none can be, as of discrete parameters.
        model: The trained model; None leaves it untrained until something asks for one
            of its densities.

    Attributes:
        was_asked: Whether something did.
    """

    def __init__(self, train: Callable[[], Any] | None, model: Any = None) -> None:
        self._train, self._model = train, model
        self.was_asked = False

    @property
    def is_trained(self) -> bool:
        """Whether the model is there without any work."""
        return self._model is not None

    def __getattr__(self, name: str) -> Any:
        is_density = name in DENSITIES
        if self._train is None:
            raise AttributeError(name)
        if is_density and self._model is None:
            # Estimates are made without gradients, training is not.
            self._model = isolated(self._train)()
        found = getattr(self._model, name)
        self.was_asked |= is_density
        return found
