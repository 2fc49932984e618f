"""Learned factors of trials, and the belief of the prior times their product."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine.learned import LearnedBelief, learned_fit
from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.mixtures import StudentMixture, fitted_normals
from sbi_active.threads import single_thread


class ActionFactor(ABC):
    """A learned factor of the likelihood of a trial.

    Attributes:
        estimator: sbi's, of flat outcomes, parameters and actions.
        belief: The distribution of theta it was trained under.
        x_shape: Shape of one outcome.
        action_dim: Numbers in an action.
    """

    def __init__(
        self,
        estimator: Any,
        belief: Distribution | None,
        x_shape: torch.Size,
        action_dim: int,
    ) -> None:
        self.estimator = estimator.eval()
        self.belief = belief
        self.x_shape, self.action_dim = torch.Size(x_shape), action_dim

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(x {tuple(self.x_shape)}, action "
            f"({self.action_dim},), {type(self.estimator).__name__})"
        )

    @abstractmethod
    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the log likelihood up to a function of (x, action), shape (n,)."""


class ActionLikelihood(ActionFactor):
    r"""Surrogate likelihood :math:`q(x | \theta, \xi)`, x flat for its network."""

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_i, \xi_i)` row by row, shape (n,).

        Args:
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        return self.estimator.log_prob(outcome[None], self._condition(theta, action))[0]

    def log_likelihood_table(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_j, \xi)` of every pair, shape (n, m).

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (m, theta_dim).
            action: One action, shape (action_dim,).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        pairs = outcome[:, None].expand(-1, len(theta), -1)
        return self.estimator.log_prob(pairs, self._condition(theta, action))

    @override
    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        return self.log_likelihood(x, theta, action)

    def sample(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return one outcome a row, shape (n, *x_shape); NaN for no measurement.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
        """
        condition = self._condition(theta, action)
        with torch.no_grad():
            x = self.estimator.sample(torch.Size([1]), condition)[0]
        return x.reshape(-1, *self.x_shape)

    def _condition(self, theta: Tensor, action: Tensor) -> Tensor:
        rows = action_rows(action, self.action_dim, num_rows=len(theta))
        return torch.cat([theta.float(), rows], 1)


class ActionRatio(ActionFactor):
    r"""Learned log ratio :math:`\log p(x | \theta, \xi) / p(x | \xi)`.

    Its estimator is of theta and packed (x, action); p(x | action) belongs to its
    belief.
    """

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log r(\theta_i; x_i, \xi_i)` row by row, shape (n,).

        Args:
            theta: Parameters, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            action: Actions, shape (n, action_dim).
        """
        rows = outcome_rows(x, self.x_shape)
        action = action_rows(action, self.action_dim, num_rows=len(rows))
        return self.estimator(theta.float(), pack(rows, action)).reshape(-1)

    log_factor = log_ratio  # its marginal knows no theta


@dataclass(frozen=True)
class Product:
    r"""The learned likelihood of all trials, where it was learned.

    .. math::
        \hat L(\theta) = 1[\theta \in R] \prod_k q(x_k | \theta, \xi_k)

    with R the region of the training rows, which were drawn from a belief that holds
    the posterior. The factors are exact products; only q is learned.

    Attributes:
        coordinates: Coordinates of the prior.
        model: q, up to factors without theta.
        trials: The history.
        region: Log density of the training rows, and its floor at the edge of R; None
            is the whole support.
        previous: Belief that takes the prior's place, where beliefs are chained.
    """

    coordinates: PriorCoordinates
    model: ActionFactor
    trials: Sequence[Observation]
    region: tuple[StudentMixture, float] | None = None
    previous: Distribution | None = None

    def log_likelihood(self, z: Array, *, batch_size: int = 20_000) -> Array:
        """Return the log likelihood, (n, d) -> (n,), so many rows in memory at once."""
        total = np.full(len(z), -np.inf)
        inside = np.ones(len(z), dtype=bool)
        if self.region is not None:
            mixture, floor = self.region
            inside = mixture.log_prob(z) >= floor
        if not inside.any():  # constraints of some priors cannot reshape no rows
            return total
        theta = self.coordinates.to_theta(z[inside])
        with torch.no_grad(), single_thread():
            parts = [self.log_factors(part) for part in theta.split(batch_size)]
        total[inside] = torch.cat(parts).numpy()
        return total

    def log_factors(self, theta: Tensor) -> Tensor:
        r"""Return the log likelihood of parameters, (n, d) -> (n,), float64.

        .. math::
            \sum_k \log q(x_k | \theta, \xi_k),

        and the log ratio of the belief that takes the prior's place to the prior.
        """
        total = torch.zeros(len(theta), dtype=torch.float64)
        for trial in self.trials:
            rows = trial.x.expand(len(theta), *trial.x.shape)
            action = trial.action.expand(len(theta), -1)
            total = total + self.model.log_factor(theta, rows, action).double()
        if self.previous is None:
            return total
        ratio = self.previous.log_prob(theta) - self.coordinates.prior.log_prob(theta)
        return total + ratio.double()


def trained_region(
    z: Array,
    rng: np.random.Generator,
    *,
    num_fitted: int = 2_000,
    lost: float = 2e-3,
    margin: float = 3.0,
) -> tuple[StudentMixture, float]:
    """Return the region of a network's training rows; elsewhere it means nothing.

    Args:
        z: Coordinates of the rows, shape (n, d).
        rng: Source of the choice of some.
        num_fitted: Number of rows that a mixture is fitted to, of components enough for
            a few modes.
        lost: Share of the rows that may lie outside.
        margin: Nats below the density of the last row inside.

    Returns:
        A mixture, and its log density at the edge.
    """
    mixture = fitted_normals(rng.permutation(z)[:num_fitted], 6, rng)
    return mixture, float(np.quantile(mixture.log_prob(z), lost)) - margin


def sample_product(
    product: Product,
    hint: Tensor | None,
    rng: np.random.Generator,
    settings: RefinementOptions,
    *,
    enough: float = 100.0,
) -> LearnedBelief:
    r"""Return the belief of a product, sampled by :func:`.infer`.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)}{Z} \prod_k q(x_k | \theta, \xi_k)
        + \epsilon\, p(\theta)

    Args:
        product: The learned likelihood of all trials.
        hint: Draws around the posterior, shape (n, theta_dim), such as those of the
            belief before; None begins at the prior.
        rng: Source of randomness.
        settings: Settings of the belief.
        enough: Effective draws below which the normalizer is off by more than a tenth
            of a nat.
    """
    prior = product.coordinates.prior
    near = None if hint is None else product.coordinates.to_z(hint)
    fit = learned_fit(product, rng, near=near, num_effective=settings.num_effective)
    belief = LearnedBelief(prior, fit, defensive=settings.defensive)
    belief.label = "product over trials"
    effective = fit.effective_sample_size
    belief.diagnostics = Diagnostics().extended(
        effective_sample_size=effective,
        likelihood="learned",
        log_normalizer=fit.log_evidence,
    )
    if effective < enough:
        belief.diagnostics = belief.diagnostics.warned(
            f"SA114 the belief rests on {effective:.0f} effective draws; raise "
            "num_particles"
        )
    return belief
