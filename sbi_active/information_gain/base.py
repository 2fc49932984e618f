"""What an estimator of the expected information gain gets and gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.simulation import NoiseModel

__all__ = ["Bound", "CandidateSimulations", "InformationGainEstimator"]

Bound = Literal["lower", "upper", "none"]


@dataclass(frozen=True)
class CandidateSimulations:
    """Outcomes of every candidate action at the same parameters.

    Attributes:
        theta: Draws from the belief, shape (n, theta_dim), common to all candidates.
        action: Candidates, shape (a, action_dim).
        x: Outcomes, shape (a, n, *x_shape); NaN where there was no measurement.
        mean: Noise-free outcomes, as x; None where the noise is not declared.
        noise: The declared noise around the mean.
        replicate: Second outcomes at the same parameters, as x; None for none.
    """

    theta: Tensor
    action: Tensor
    x: Tensor
    mean: Tensor | None = None
    noise: NoiseModel | None = None
    replicate: Tensor | None = None

    @property
    def complete(self) -> Tensor:
        """Outcomes without any NaN, shape (a, n), bool; their replicates as well."""
        complete = self.x.flatten(2).isfinite().all(-1)
        if self.replicate is not None:
            complete &= self.replicate.flatten(2).isfinite().all(-1)
        return complete

    def rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return theta, x and action with one row a pair, a * n rows each."""
        num_actions, num_samples = self.x.shape[:2]
        return (
            self.theta.repeat(num_actions, 1),
            self.x.flatten(0, 1),
            self.action.repeat_interleave(num_samples, 0),
        )

    def candidates(self, index: Tensor) -> CandidateSimulations:
        """Return some candidates, index (k,)."""
        parts = {name: part[index] for name, part in self._outcomes().items()}
        return replace(self, action=self.action[index], **parts)

    def samples(self, rows: slice) -> CandidateSimulations:
        """Return some of the simulations of every candidate."""
        parts = {name: part[:, rows] for name, part in self._outcomes().items()}
        return replace(self, theta=self.theta[rows], **parts)

    def join(self, other: CandidateSimulations) -> CandidateSimulations:
        """Return these and further simulations of the same candidates."""
        more = other._outcomes()
        parts = {
            name: torch.cat([part, more[name]], 1)
            for name, part in self._outcomes().items()
        }
        return replace(self, theta=torch.cat([self.theta, other.theta]), **parts)

    def _outcomes(self) -> dict[str, Tensor]:
        parts = {"x": self.x, "mean": self.mean, "replicate": self.replicate}
        return {name: part for name, part in parts.items() if part is not None}

    def unpaired(self) -> CandidateSimulations:
        """Return replicates as further simulations, 2 n in all."""
        if self.replicate is None:
            return self
        x = torch.cat([self.x, self.replicate], 1)
        return CandidateSimulations(self.theta.repeat(2, 1), self.action, x)


class InformationGainEstimator(ABC):
    r"""Estimator of :math:`I(\theta; x | \xi)` in nats for a set of candidates.

    Attributes:
        bound: Which side of the information the estimate's expectation lies on.
        needs_noise: Whether it uses the declared noise, or else replicates.
        needs_model: Whether it uses something learned.
    """

    bound: Bound = "none"
    needs_noise: bool = False
    needs_model: bool = True

    def __call__(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        r"""Return the contribution of every simulation; their mean is the estimate.

        Args:
            model: What was learned, see the estimator.
            simulations: Fresh simulations, not those the model was trained on.
            belief: Density of theta in the simulations.

        Returns:
            Shape (a, n), nats, float64.

        Raises:
            ValueError: If shapes do not fit, or the noise is neither declared nor
                replicated where it is needed.
        """
        theta, action, x = simulations.theta, simulations.action, simulations.x
        if x.ndim < 3 or x.shape[:2] != (len(action), len(theta)):
            raise ValueError(
                f"expected x of shape ({len(action)}, {len(theta)}, *x_shape), one "
                f"outcome a candidate and parameter set; got {tuple(x.shape)}; do "
                "simulate every candidate at the same parameters"
            )
        unknown = simulations.mean is None or simulations.noise is None
        if self.needs_noise and unknown and simulations.replicate is None:
            raise ValueError(
                f"expected declared noise or replicates for {type(self).__name__}; got "
                "neither; do build SimulatorModel(fn, noise=...) around a noise-free "
                "fn, or simulate every theta twice"
            )
        with torch.no_grad():
            return self._contributions(model, simulations, belief).double()

    def problems(self, simulations: CandidateSimulations) -> list[str]:
        """Return what speaks against the estimator on these simulations.

        Args:
            simulations: As in a call.

        Returns:
            Short sentences; none where every check passes.
        """
        return []

    @abstractmethod
    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        """Return the contributions, shape (a, n)."""
