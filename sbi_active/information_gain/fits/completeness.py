"""Probability of a complete outcome, as a function of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.information_gain.base import CandidateSimulations
from sbi_active.information_gain.fits.classification import probability
from sbi_active.information_gain.fits.emulator import MeanEmulator
from sbi_active.information_gain.fits.presence import random_presence


@dataclass(frozen=True)
class Completeness:
    """Probability of a complete outcome of one candidate.

    Attributes:
        share: Share of a row's outcomes that are complete, shape (n,).
        counted: Rows that are not missing, shape (n,).
        smooth: Log probability as a function of the parameters, where it is random.
    """

    share: Tensor
    counted: Tensor
    smooth: Callable[[Tensor], Tensor] | None

    @property
    def log_probability(self) -> Tensor:
        """Log of the share of complete outcomes."""
        return self.share[self.counted].mean().log()

    def __call__(self, z: Tensor, emulator: MeanEmulator) -> Tensor:
        """Return the log probability at coordinates, shape (k,)."""
        if self.smooth is not None:
            return self.smooth(emulator.parameters(z))
        if bool((self.share[self.counted] == 1).all()):
            return torch.zeros(len(z), dtype=z.dtype)
        nearest = torch.cdist(z, emulator.knots[self.counted]).argmin(1)
        return self.share[self.counted][nearest].log()


def completeness(simulations: CandidateSimulations) -> list[Completeness]:
    """Return the completeness of each candidate's outcomes."""
    theta = simulations.theta.double()
    outcomes = simulations.outcomes()
    label = torch.stack([x.flatten(2).isfinite().all(-1) for x in outcomes], 1).double()
    random = random_presence(simulations).tolist()
    result = []
    for a, (share, counted) in enumerate(
        zip(simulations.completeness, simulations.counted, strict=True)
    ):
        smooth = None
        if random[a]:
            smooth = probability(
                theta, label[a], counted.double().expand(len(outcomes), -1)
            )
        result.append(Completeness(share, counted, smooth))
    return result
