"""Interface of an estimator of the expected information gain."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import Shown, require
from sbi_active.simulation import NoiseModel

Bound = Literal["lower", "upper", "none"]


@dataclass(frozen=True)
class CandidateSimulations:
    """Outcomes of every candidate action at the same parameters.

    Attributes:
        theta: Draws from the belief, shape (n, theta_dim), common to all candidates.
        action: Candidates, shape (a, action_dim).
        x: Outcomes, shape (a, n, *x_shape); NaN where there was no measurement.
        mean: Noise-free outcomes, as x; None if the noise is not declared.
        noise: The declared noise around the mean.
        replicate: Second outcomes at the same parameters, as x; None for none.
        missing: Rows lost to a fault that has nothing to do with the parameters, shape
            (a, n), bool, the replicate's included; None for none. They are ignored,
            unlike outcomes without a measurement, whose NaN is information.
        sd: Standard deviations of the noise around the mean, as x, where rivals have
            noise of their own; else None.
        fisher: Information matrices of the simulator's own slopes, in units of the
            noise, shape (a, n, k, theta_dim, theta_dim), of each of k joint outcomes;
            NaN at most parameters, None for none.
    """

    theta: Tensor
    action: Tensor
    x: Tensor
    mean: Tensor | None = None
    noise: NoiseModel | None = None
    replicate: Tensor | None = None
    missing: Tensor | None = None
    sd: Tensor | None = None
    fisher: Tensor | None = None

    @property
    def counted(self) -> Tensor:
        """Rows that are not missing, shape (a, n), bool."""
        if self.missing is None:
            return torch.ones(self.x.shape[:2]).bool()
        return ~self.missing

    @property
    def present(self) -> Tensor:
        """Numbers that there are of x and of replicates, (1 or 2, a, n, q), bool."""
        return torch.stack([part.flatten(2).isfinite() for part in self.outcomes()])

    @property
    def complete(self) -> Tensor:
        """Outcomes without any NaN, shape (a, n), bool; their replicates as well."""
        return self.completeness == 1

    @property
    def completeness(self) -> Tensor:
        """Share of a row's outcomes, x and replicate, without NaN, shape (a, n)."""
        return self.present.all(-1).double().mean(0) * self.counted

    @property
    def partly_observed(self) -> Tensor:
        """Outcomes of which some numbers are present, shape (a, n), bool."""
        present = self.present
        return (present.any(-1) & ~present.all(-1)).any(0) & self.counted

    def num_valid(self) -> Tensor:
        """Return the numbers of outcomes with a measurement, and of all, shape (2, a).

        A partly observed outcome has one; missing rows are not counted.
        """
        valid = self.present.any(-1) & self.counted
        return torch.stack([valid.sum((0, 2)), len(valid) * self.counted.sum(1)])

    def outcomes(self) -> list[Tensor]:
        """Return x and, where there are any, replicates."""
        return [self.x] if self.replicate is None else [self.x, self.replicate]

    def candidates(self, index: Tensor) -> CandidateSimulations:
        """Return some candidates, index (k,)."""
        parts = {name: part[index] for name, part in self.parts().items()}
        return replace(self, action=self.action[index], **parts)

    def samples(self, rows: slice) -> CandidateSimulations:
        """Return some of the simulations of every candidate."""
        parts = {name: part[:, rows] for name, part in self.parts().items()}
        return replace(self, theta=self.theta[rows], **parts)

    def join(self, other: CandidateSimulations) -> CandidateSimulations:
        """Return these and further simulations of the same candidates."""
        more = other.parts()
        parts = {
            name: torch.cat([part, more[name]], 1)
            for name, part in self.parts().items()
        }
        return replace(self, theta=torch.cat([self.theta, other.theta]), **parts)

    def parts(self) -> dict[str, Tensor]:
        """Return what there is of every simulation of every candidate, by name."""
        names = ("x", "mean", "replicate", "missing", "sd", "fisher")
        parts = {name: getattr(self, name) for name in names}
        return {name: part for name, part in parts.items() if part is not None}


class Sampler(ABC):
    """Source of outcomes of candidates.

    Attributes:
        others: Actions whose outcomes will be known as well, shape (p, action_dim).
        summaries: Summaries that stand for the numbers of an outcome; None keeps all.
        notes: Notes on the outcomes.
        num_drawn: Simulations so far.
        num_missing: Number of those simulations lost to faults of the simulator.
    """

    others: Tensor = torch.empty(0, 0)
    summaries: Any = None
    notes: Sequence[str] = ()
    num_drawn = num_missing = _num_waves = 0

    @abstractmethod
    def draw(self, num_samples: int, action: Tensor) -> CandidateSimulations:
        """Return outcomes of candidates (a, action_dim) at the same parameters."""

    def rewind(self) -> None:
        """Repeat the parameters and the noise of the first draw in the next."""
        self._num_waves = 0


class InformationGainEstimator(Shown, ABC):
    r"""Estimator of :math:`I(\theta; x | \xi)` in nats for a set of candidates.

    Attributes:
        bound: Side of the information that the estimate's expectation lies on, whatever
            the model.
        needs_noise: Whether it uses the declared noise, or else replicates.
        needs_model: Whether it uses something learned.
        fewest: Outcomes of a candidate that an estimate needs.
    """

    bound: Bound = "none"
    needs_noise: bool = False
    needs_model: bool = True
    fewest: int = 8

    def __call__(
        self,
        model: Any,
        simulations: CandidateSimulations,
        belief: Distribution | None,
    ) -> Tensor:
        """Return the contribution of every simulation; their mean is the estimate.

        Args:
            model: Model that was learned, see the estimator.
            simulations: Fresh simulations, not those the model was trained on.
            belief: Density of theta in the simulations; None if an estimator has no
                use for it.

        Returns:
            Shape (a, n), nats, float64; NaN for missing rows.

        Raises:
            ValueError: If shapes do not fit, or the noise is neither declared nor
                replicated where it is needed, or the model gives NaN for an outcome.
        """
        theta, action, x = simulations.theta, simulations.action, simulations.x
        require(
            x.ndim > 2 and x.shape[:2] == (len(action), len(theta)),
            f"x of shape ({len(action)}, {len(theta)}, *x_shape)",
            *(tuple(x.shape), "simulate every candidate at the same parameters"),
        )
        declared = simulations.mean is not None and simulations.noise is not None
        require(
            declared or simulations.replicate is not None or not self.needs_noise,
            *(f"declared noise or replicates for {type(self).__name__}", "neither"),
            "build SimulatorModel(fn, noise=...) around a noise-free fn, or simulate "
            "every theta twice",
        )
        with torch.no_grad():
            gain = self._contributions(model, simulations, belief).double()
        lost = int((gain.isnan() & simulations.counted).sum())
        require(  # a mean of the others would hide it
            not (self.needs_model and lost),
            f"densities of {type(model).__name__}",
            f"NaN at {lost} of {gain.numel()} outcomes",
            "give a model that says how probable an outcome without a measurement is, "
            "x = NaN, or train it again",
        )
        return gain.masked_fill(~simulations.counted, torch.nan)

    def bound_on(self, model: Any) -> Bound:
        """Return the side of the information that the estimate's expectation lies on.

        A model with ``exact_likelihood = True`` has an exact likelihood, others a
        learned one.
        """
        return self.bound

    def cautions(self, gain: Tensor) -> list[str]:
        """Return cautions about contributions (a, n), as a limit that is near."""
        return []

    def compared(
        self, model: Any, simulations: CandidateSimulations, belief: Any, gain: Tensor
    ) -> list[str]:
        """Return cautions about contributions that came of these, as by a bound."""
        return self.cautions(gain)

    def problems(self, simulations: CandidateSimulations) -> list[str]:
        """Say in short sentences what speaks against the estimator here."""
        return []

    def needs_slopes(self, simulations: CandidateSimulations) -> bool:
        """Return whether estimates need slopes of the simulator, see ``fisher``."""
        return False

    def remarks(self, simulations: CandidateSimulations) -> list[str]:
        """Return remarks on an estimate from simulations."""
        return []

    @abstractmethod
    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Any
    ) -> Tensor:
        """Return the contributions, shape (a, n)."""


def whitening(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return the center of rows (n, d) and what whitens them, (d,) and (d, d)."""
    d = theta.shape[1]
    size = theta.abs().amax(0).clamp_min(1e-30)
    spread = torch.maximum(theta.std(0), 1e-9 * size)  # of draws that are all alike
    covariance = torch.cov((theta / spread).T).reshape(d, d) + 1e-8 * torch.eye(d)
    factor = torch.linalg.cholesky(covariance)
    return theta.mean(0), torch.linalg.inv(factor).T / spread[:, None]


def noise_scale(simulations: CandidateSimulations) -> Tensor:
    """Return the root mean square of declared noise, shape (a, numbers of x)."""
    assert simulations.mean is not None
    square = (simulations.x - simulations.mean).flatten(2).double().square().nanmean(1)
    return torch.where(square > 0, square, 1.0).sqrt()


def standard_error(contributions: Tensor) -> Tensor:
    """Return standard errors of means over the last axis, of NaN where missing."""
    known = contributions.where(contributions.isfinite(), torch.nan)
    square = (known - known.nanmean(-1, keepdim=True)).square().nansum(-1)
    num = known.isfinite().sum(-1)
    return (square / (num - 1) / num).sqrt()


def at_least(value: int, least: int, name: str, usual: int) -> int:
    """Return a count, or raise a ValueError where it is too small."""
    require(value >= least, f"{name} >= {least}", value, f"use about {usual}")
    return value
