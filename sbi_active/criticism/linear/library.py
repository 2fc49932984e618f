"""A fitted model with a column of every effect that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.mixture import Mixture, either
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.detection import log_prior


class Library:
    """A model at its best fit, with a column of every effect that it lacks.

    Coordinates of these effects count from where their columns were taken.

    Args:
        base: Key of the model.
        fitted: The model.
        columns: Model with each further effect where it vanishes, and the columns of
            that effect, by name.
        errors: Errors that all models share.
        prior: Log prior probabilities of "none" and each effect.
    """

    def __init__(
        self,
        base: ModelKey,
        fitted: LinearModel,
        columns: Mapping[str, tuple[LinearModel, NDArray[np.bool_]]],
        errors: Errors,
        prior: Mapping[str, float],
    ) -> None:
        self.base, self.columns, self.errors, self.prior = base, columns, errors, prior
        self.names = [*columns]
        parts = [model.from_here().part(own) for model, own in columns.values()]
        self._every = fitted.joined(parts)
        self._own = np.arange(len(fitted.u))
        ends = np.cumsum([len(fitted.u), *[len(part.u) for part in parts]])
        each = zip(self.names, ends[:-1], ends[1:], strict=True)
        self._places = {name: np.arange(first, last) for name, first, last in each}
        self._prepared, self._grams = self._own[:0], None
        self._found: dict[tuple[str, ...], list[Mixture]] = {}

    def prepare(self, names: Sequence[str]) -> None:
        """Compute once what all pairs of some effects take, in the library's order."""
        self._prepared = self._at(names)
        self._grams = self.errors.grams(self._every.part(self._prepared).rows)

    def scores(
        self, names: Sequence[str], num: int, *, most: int = 12
    ) -> dict[tuple[str, ...], float]:
        """Return the log posterior probabilities of all sets of some effects.

        Args:
            names: Effects, in the library's order.
            num: Number of effects of a set.
            most: Number of effects alone whose Gram matrices are in memory at once.
        """
        size = most if num == 1 else max(len(names), 1)
        found = {}
        for start in range(0, len(names), size):
            some = names[start : start + size]
            self.prepare(some)
            found |= {new: self.score(new) for new in combinations(some, num)}
        return found

    def score(self, names: tuple[str, ...]) -> float:
        """Return the log posterior probability of a set, unnormalized."""
        every = (*self.base.effects, *names)
        return either(*self._posterior(names)) + log_prior(every, self.prior)

    def _at(self, names: Sequence[str]) -> NDArray[np.intp]:
        return np.concatenate([self._own, *[self._places[name] for name in names]])

    def _posterior(self, names: tuple[str, ...]) -> list[Mixture]:
        if names not in self._found:
            at, grams = self._at(names), self._grams
            model = self._every.part(at)
            if grams is None or not np.isin(at, self._prepared).all():
                grams = self.errors.grams(model.rows)
            else:
                rows = np.append(0, 1 + np.searchsorted(self._prepared, at))
                grams = replace(grams, gram=grams.gram[..., rows[:, None], rows])
            self._found[names] = [
                self.errors.mixture(model, grams, beside=b) for b in (False, True)
            ]
        return self._found[names]
