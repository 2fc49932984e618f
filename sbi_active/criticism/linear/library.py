"""A fitted model with a column of every effect that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.mixture import either
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import Grams
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
            known = self._at(some)
            grams = self.errors.grams(self._every.part(known))
            for new in combinations(some, num):
                found[new] = self._score(new, known, grams)
        return found

    def _at(self, names: Sequence[str]) -> NDArray[np.intp]:
        return np.concatenate([self._own, *[self._places[name] for name in names]])

    def _score(
        self, names: tuple[str, ...], known: NDArray[np.intp], grams: Grams
    ) -> float:
        """Return the log posterior probability of a set, unnormalized.

        Args:
            names: Further effects of the set.
            known: Coordinates of the Gram matrices, ascending.
            grams: Gram matrices with, among others, all rows of the set.
        """
        at = self._at(names)
        rows = np.append(0, 1 + np.searchsorted(known, at))
        own = replace(grams, gram=grams.gram[..., rows[:, None], rows])
        given, mixture = (self._every.part(at), own), self.errors.mixture
        both = (mixture(*given, beside=beside) for beside in (False, True))
        return either(*both) + log_prior((*self.base.effects, *names), self.prior)
