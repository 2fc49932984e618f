"""A fitted model with a column of every effect that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.linear.errors import Errors, Grams, Posterior
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.tracing import log_prior


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
        self.base, self.fitted = base, fitted
        self.errors, self.prior = errors, prior
        self.names = [*columns]
        self._singles = {name: model for name, (model, _) in columns.items()}
        self._blocks = {name: own for name, (_, own) in columns.items()}
        self._grams: Grams | None = None
        self._places: dict[str, NDArray[np.intp]] = {}
        self._found: dict[tuple[str, ...], Posterior] = {}

    def prepare(self, names: Sequence[str]) -> None:
        """Compute once what all pairs of some effects take."""
        dim = 1 + len(self.fitted.u)
        for name in names:
            width = int(self._blocks[name].sum())
            self._places[name] = np.arange(dim, dim + width)
            dim += width
        self._grams = self.errors.grams(self._model(names).rows)

    def beside(self, name: str) -> tuple[LinearModel, NDArray[np.bool_]]:
        """Return the model with one effect where it vanishes, and its columns."""
        return self._singles[name], self._blocks[name]

    def look_at_each(self) -> None:
        """Compute the posterior of each effect alone, a dozen at a time."""
        together = 12
        for start in range(0, len(self.names), together):
            some = self.names[start : start + together]
            self.prepare(some)
            for name in some:
                self._posterior((name,))
        self._grams, self._places = None, {}

    def score(self, names: tuple[str, ...]) -> float:
        """Return the log posterior probability of a set, unnormalized."""
        every = (*self.base.effects, *names)
        return self._posterior(names).log_evidence + log_prior(every, self.prior)

    def optimum(self, name: str) -> tuple[ModelKey, Array]:
        """Return the key of a model with one effect, and its linear optimum, (d,)."""
        model, own = self._singles[name], self._blocks[name]
        mean = self._posterior((name,)).beside.mean
        u = np.empty(len(model.u))
        u[~own], u[own] = mean[: (~own).sum()], mean[(~own).sum() :] + model.u[own]
        return model.key, np.clip(u, model.low, model.high)

    def _posterior(self, names: tuple[str, ...]) -> Posterior:
        if names not in self._found:
            model, errors = self._model(names), self.errors
            self._found[names] = errors.posterior(model, self._grams_of(names, model))
        return self._found[names]

    def _grams_of(self, names: tuple[str, ...], model: LinearModel) -> Grams:
        if self._grams is None or any(n not in self._places for n in names):
            return self.errors.grams(model.rows)
        at = np.arange(1 + len(self.fitted.u))
        at = np.concatenate([at, *[self._places[n] for n in names]])
        gram = self._grams.gram[..., at[:, None], at]
        return Grams(gram, self._grams.log_det, self._grams.count)

    def _model(self, names: Sequence[str]) -> LinearModel:
        """Return the model with the columns of some effects after its own."""
        fitted = self.fitted
        parts = [(self._singles[n], self._blocks[n]) for n in names]

        def joined(field: str) -> Array:
            own = [getattr(model, field)[block] for model, block in parts]
            return np.concatenate([getattr(fitted, field), *own])

        def shifted(field: str) -> Array:
            own = [(getattr(m, field) - m.u)[block] for m, block in parts]
            return np.concatenate([getattr(fitted, field), *own])

        columns = [model.jacobian[:, block] for model, block in parts]
        null = [np.zeros(block.sum()) for _, block in parts]
        return LinearModel(
            key=ModelKey(tuple(names)),
            u=np.concatenate([fitted.u, *null]),
            residual=fitted.residual,
            jacobian=np.concatenate([fitted.jacobian, *columns], 1),
            center=shifted("center"),
            sd=joined("sd"),
            scaled=joined("scaled"),
            low=shifted("low"),
            high=shifted("high"),
            own=fitted.own,
            trial_of=joined("trial_of"),
            num=fitted.num,
            scale=fitted.scale,
            offset=fitted.offset,
        )
