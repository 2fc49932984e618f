"""Functions of outcomes and parameters that a model has learned, in batches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor


class PosteriorModel(Protocol):
    """Anything with a conditional density of parameters."""

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return log q(theta_i | x_i, action_i), shape (n,)."""
        ...


class LikelihoodModel(Protocol):
    """Anything with a conditional density of outcomes.

    An exact likelihood, rather than a learned one, has ``exact_likelihood = True``. It
    may have ``log_likelihood_table(x, theta, action)`` as well: outcomes (n, *x_shape),
    parameters (m, theta_dim) and one action (action_dim,), all pairs of them, -> (n,
    m). A network whose condition is (theta, action) then runs m times, not n m times.
    """

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return log q(x_i | theta_i, action_i), shape (n,).

        Rows of x are NaN where there was no measurement; the log probability of that is
        then asked for.
        """
        ...


class RatioModel(Protocol):
    """Anything with a likelihood-to-marginal ratio."""

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return log q(x_i | theta_i, action_i) - log q(x_i | action_i), shape (n,).

        Rows of x are NaN where there was no measurement.
        """
        ...


@dataclass(frozen=True)
class Critic:
    r"""A function :math:`f(x, \theta | \xi)` of the model, evaluated in batches.

    Attributes:
        model: Model that was learned.
        methods: Methods of a model that are such a function; the first that this one
            has is f.
        user: Name of the caller, for errors.
        batch_size: Rows in one pass.
    """

    model: Any
    methods: tuple[str, ...]
    user: str
    batch_size: int

    @property
    def method(self) -> str:
        """Name of the model's method.

        Raises:
            ValueError: If it has none.
        """
        for name in self.methods:
            if hasattr(self.model, name):
                return name
        raise ValueError(
            f"expected a model with {self.methods[-1]} for {self.user}; got "
            f"{type(self.model).__name__}; pass one that has it, or choose "
            "estimator='auto'"
        )

    def rows(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return f of every row, shape (n,), float64.

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).

        Raises:
            ValueError: If the model cannot say of a row.
        """
        evaluate = getattr(self.model, self.method)
        parts = [part.split(self.batch_size) for part in (x, theta, action)]
        values = [
            evaluate(*self._order(*batch)).double()
            for batch in zip(*parts, strict=True)
        ]
        return self._known(torch.cat(values))

    def table(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        """Return f of every outcome with every parameter set, shape (n, m), float64.

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (m, theta_dim).
            action: One action, shape (action_dim,).
        """
        all_pairs = getattr(self.model, f"{self.method}_table", None)
        if all_pairs is not None:
            return self._known(all_pairs(*self._order(x, theta, action)).double())
        n, m = len(x), len(theta)
        values = self.rows(
            x.repeat_interleave(m, 0), theta.repeat(n, 1), action.expand(n * m, -1)
        )
        return values.reshape(n, m)

    def _order(self, x: Tensor, theta: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        is_likelihood = self.method == "log_likelihood"
        return (x, theta, action) if is_likelihood else (theta, x, action)

    def _known(self, values: Tensor) -> Tensor:
        if bool(values.isnan().any()):
            raise ValueError(
                f"expected numbers from {type(self.model).__name__}.{self.method} for "
                f"{self.user}; got NaN in {int(values.isnan().sum())} of "
                f"{values.numel()} rows; give a model that says how probable an "
                "outcome without a measurement is, x = NaN"
            )
        return values
