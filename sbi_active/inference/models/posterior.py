"""The posterior over parameters given an outcome and the action that led to it."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from sbi.sbi_types import Shape
from torch import Tensor, nn

from sbi_active.inference.networks.mixture_network import (
    MISSING,
    MixtureDensityNetwork,
)
from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack
from sbi_active.messages import warn

#: What a posterior is given; None says that it is missing, which is an error.
Given = Tensor | None


class ActionPosterior:
    r"""Amortized posterior :math:`q(\theta | x, \xi)`.

    It has the methods of sbi's posteriors with ``x=`` and ``action=`` together. Code
    that only knows a posterior over x takes :meth:`at`, and code that knows one over
    packed (x, action) takes :meth:`packed`.

    Args:
        packed: sbi's posterior over packed conditions.
        x_shape: Shape of one outcome.
        action_dim: Numbers in an action.

    Attributes:
        belief: The belief the estimator was trained under.
    """

    def __init__(
        self, packed: NeuralPosterior, x_shape: torch.Size, action_dim: int
    ) -> None:
        self._packed = packed
        self.x_shape = torch.Size(x_shape)
        self.action_dim = action_dim
        self.belief = packed.prior if isinstance(packed, DirectPosterior) else None

    def __repr__(self) -> str:
        return (
            f"ActionPosterior(x {tuple(self.x_shape)}, action ({self.action_dim},), "
            f"{type(self._packed).__name__})"
        )

    def sample(
        self,
        sample_shape: Shape = (),
        x: Given = None,
        action: Given = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return draws given one outcome.

        Args:
            sample_shape: Shape of the draws, any.
            x: The outcome, shape x_shape or (1, *x_shape); NaN where there was no
                measurement.
            action: The action that led to it, shape (action_dim,) or (1, action_dim).
            kwargs: Arguments passed to sbi's ``sample``.

        Returns:
            Shape (*sample_shape, theta_dim).

        Raises:
            ValueError: If x or action is missing or has another shape.
        """
        kwargs.setdefault("show_progress_bars", False)
        posterior, condition = self._given(x, action)
        draws = posterior.sample(sample_shape, x=condition, **kwargs)
        return draws.reshape(*torch.Size(sample_shape), -1)

    def sample_batched(
        self, sample_shape: Shape, x: Given = None, action: Given = None, **kwargs: Any
    ) -> Tensor:
        """Return draws given each of b outcomes, shape (*sample_shape, b, theta_dim).

        Args:
            sample_shape: Shape of the draws, any.
            x: Outcomes, shape (b, *x_shape).
            action: Actions, shape (b, action_dim), or (action_dim,) for all.
            kwargs: Arguments passed to sbi's ``sample_batched``.
        """
        kwargs.setdefault("show_progress_bars", False)
        posterior, condition = self._given(x, action)
        return posterior.sample_batched(sample_shape, x=condition, **kwargs)

    def log_prob(
        self, theta: Tensor, x: Given = None, action: Given = None, **kwargs: Any
    ) -> Tensor:
        """Return the log density of parameters given one outcome.

        Args:
            theta: Parameters, shape (n, theta_dim).
            x: The outcome, shape x_shape or (1, *x_shape).
            action: The action that led to it.
            kwargs: Arguments passed to sbi's ``log_prob``.

        Returns:
            Shape (n,); -inf outside the prior's support.
        """
        self._direct()
        posterior, condition = self._given(x, action)
        return posterior.log_prob(theta.float(), x=condition, **kwargs)

    def log_prob_batched(
        self, theta: Tensor, x: Given = None, action: Given = None, **kwargs: Any
    ) -> Tensor:
        """Return log densities given each of several outcomes, shape (n, b).

        Args:
            theta: Parameters, shape (n, b, theta_dim).
            x: Outcomes, shape (b, *x_shape).
            action: Actions, shape (b, action_dim), or (action_dim,) for all.
            kwargs: Arguments passed to sbi's ``log_prob_batched``.
        """
        self._direct()
        posterior, condition = self._given(x, action)
        return posterior.log_prob_batched(theta.float(), x=condition, **kwargs)

    def map(self, x: Given = None, action: Given = None, **kwargs: Any) -> Tensor:
        """Return the parameters of highest density, shape (1, theta_dim).

        Args:
            x: The outcome, shape x_shape or (1, *x_shape).
            action: The action that led to it.
            kwargs: Arguments passed to sbi's ``map``.
        """
        posterior, condition = self._given(x, action)
        if "init_method" not in kwargs:
            num = kwargs.get("num_init_samples", 1_000)
            kwargs["init_method"] = self.sample((num,), x=x, action=action)
        return deepcopy(posterior).set_default_x(condition).map(**kwargs)

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(\theta_i | x_i, \xi_i)` row by row, shape (n,).

        There is no leakage correction, which a bound on the information does not need.

        Args:
            theta: Parameters, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            action: Actions, shape (n, action_dim).
        """
        condition = self._condition(x, action)
        return self._direct().posterior_estimator.log_prob(
            theta[None].float(), condition
        )[0]

    def packed(self) -> NeuralPosterior:
        """Return sbi's posterior over packed (x, action), x flattened."""
        return self._packed

    def at(self, action: Tensor) -> DirectPosterior:
        """Return sbi's posterior over x at an action (action_dim,), for diagnostics."""
        direct = self._direct()
        row = action_rows(action, self.action_dim, num_rows=1)
        estimator = _AtAction(direct.posterior_estimator, self.x_shape, row)
        return DirectPosterior(estimator, direct.prior)

    def _direct(self) -> DirectPosterior:
        if not isinstance(self._packed, DirectPosterior):
            raise ValueError(
                "expected a posterior with a density; got one that only samples, "
                f"{type(self._packed).__name__}; build_posterior() with "
                "sample_with='direct'"
            )
        return self._packed

    def _given(self, x: Given, action: Given) -> tuple[Any, Tensor]:
        """Return a posterior of sbi's and the condition it takes.

        sbi refuses NaN, which here says that nothing was measured: a network that takes
        it is given another number for it.
        """
        condition = self._condition(x, action)
        if bool(condition.isfinite().all()) or not isinstance(
            self._packed, DirectPosterior
        ):
            return self._packed, condition
        network = self._packed.posterior_estimator
        if not isinstance(network, MixtureDensityNetwork):
            return self._packed, condition  # sbi says what is wrong
        if not network.knows(condition):
            warn(
                "SA107 the network has never seen an outcome like this: no simulation "
                "it was trained on lacks these numbers, so what it says is arbitrary"
            )
        return self._packed, condition.nan_to_num(MISSING)

    def _condition(self, x: Given, action: Given) -> Tensor:
        if x is None or action is None:
            given = "x without action" if action is None else "action without x"
            given = "neither" if x is action else given
            raise ValueError(
                f"expected x= and action= together; got {given}; pass both, or "
                "posterior.at(action) to something that only knows x"
            )
        rows = outcome_rows(x, self.x_shape)
        return pack(rows, action_rows(action, self.action_dim, num_rows=len(rows)))


class _AtAction(ConditionalDensityEstimator):
    """A packed estimator at one action, whose condition is x alone.

    Args:
        packed: Estimator over packed conditions.
        x_shape: Shape of one outcome.
        action: The action, shape (1, action_dim).
    """

    def __init__(
        self, packed: ConditionalDensityEstimator, x_shape: torch.Size, action: Tensor
    ) -> None:
        super().__init__(nn.Identity(), packed.input_shape, x_shape)
        self.packed, self.action = packed, nn.Buffer(action)

    def _pack(self, x: Tensor) -> Tensor:
        flat = x.flatten(x.ndim - len(self.condition_shape))
        return torch.cat([flat, self.action[0].expand(*flat.shape[:-1], -1)], -1)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return self.packed.log_prob(input, self._pack(condition), **kwargs)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return self.packed.loss(input, self._pack(condition), **kwargs)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        return self.packed.sample(sample_shape, self._pack(condition), **kwargs)
