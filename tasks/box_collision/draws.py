"""Draws under all proposals so far, and what was simulated at them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sbi_active.tasks.box_collision.proposal import KernelMixture, log_normal

__all__ = ["Draws", "Evidence"]

NEGLIGIBLE = 16.0  # nats below the heaviest draw: a weight below 1.2e-7 of it
CHUNK = 256  # draws between two looks at how heavy the heaviest is
NEAR = 15.0  # nats below a perfect fit, from where a trial may yet be explained


@dataclass(frozen=True, kw_only=True)
class Evidence:
    r"""One trial's log likelihood as a function of noise-free positions.

    Attributes:
        speed: Executed, m/s.
        log_likelihood: Takes positions (n, 3), gives (n,), nats.
        ceiling: The largest that it can be.
    """

    speed: float
    log_likelihood: Callable[[Tensor], Tensor]
    ceiling: float


@dataclass
class Draws:
    r"""Draws z whose law is the mixture of all proposals that they came from.

    Positions are kept by speed, so that a trial at a speed that was simulated before
    costs nothing; a draw that no trial left to look at can save is not simulated
    further.

    Attributes:
        z: Shape (n, 3), N(0, I) under the prior.
        log_mixture: :math:`\log \sum_k n_k q_k(z)`, shape (n,).
        proposals: Number of draws and density of each :math:`q_k`; None is the prior.
        positions: By speed, shape (n, 3).
        known: By speed, which of them were simulated, shape (n,).
    """

    z: Tensor = field(default_factory=lambda: torch.empty(0, 3, dtype=torch.float64))
    log_mixture: Tensor = field(
        default_factory=lambda: torch.empty(0, dtype=torch.float64)
    )
    proposals: tuple[tuple[int, KernelMixture | None], ...] = ()
    positions: dict[float, Tensor] = field(default_factory=dict)
    known: dict[float, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.z)

    @property
    def log_ratio(self) -> Tensor:
        """Log of prior over mixture, shape (n,)."""
        return log_normal(self.z) - self.log_mixture

    def with_more(
        self, num: int, proposal: KernelMixture | None, generator: torch.Generator
    ) -> Draws:
        """Return these and others, all of them under the mixture with one more part."""
        new = (
            torch.randn(num, 3, generator=generator, dtype=torch.float64)
            if proposal is None
            else proposal.sample(num, generator)
        )
        parts = [
            _log_prob(density, new) + math.log(size) for size, density in self.proposals
        ]
        log_new = torch.stack([_log_prob(proposal, new) + math.log(num), *parts])
        log_old = (
            log_normal(self.z)
            if proposal is None
            else proposal.log_prob(self.z, has_sources=True)
        )
        log_old += math.log(num)
        return replace(
            self,
            z=torch.cat([self.z, new]),
            log_mixture=torch.cat(
                [torch.logaddexp(self.log_mixture, log_old), log_new.logsumexp(0)]
            ),
            proposals=(*self.proposals, (num, proposal)),
            positions={
                speed: torch.cat([x, x.new_full((num, 3), torch.nan)])
                for speed, x in self.positions.items()
            },
            known={
                speed: torch.cat([mask, mask.new_zeros(num)])
                for speed, mask in self.known.items()
            },
        )

    def log_likelihood(
        self, trials: Sequence[Evidence], simulate: Callable[[Tensor, float], Tensor]
    ) -> tuple[Tensor, Tensor]:
        r"""Return the log likelihood of all trials, or a bound, where it is negligible.

        Draws are looked at from the most promising on, and trial by trial; one is given
        up when even a perfect fit of the trials left could not bring its weight within
        :data:`NEGLIGIBLE` nats of the heaviest.

        Args:
            trials: What was observed.
            simulate: Takes z (k, 3) and a speed, gives noise-free positions (k, 3).

        Returns:
            The log likelihood, or an upper bound of it, shape (n,); and whether it is
            the former, shape (n,), bool.
        """
        num, log_ratio = len(self), self.log_ratio
        total = torch.zeros(num, dtype=torch.float64)
        pending = torch.zeros(num, dtype=torch.float64)  # of trials not simulated yet
        for trial in trials:
            known = self._known(trial.speed)
            value = trial.log_likelihood(self.positions[trial.speed])
            total += value.where(known, torch.zeros(()).double())
            pending += trial.ceiling * ~known
        heaviest = -torch.inf
        trials = self._most_selective_first(trials)
        order = (log_ratio + total + pending).argsort(descending=True)
        for rows in order.split(CHUNK):
            for trial in trials:
                bound = (log_ratio + total + pending)[rows]
                rows = rows[bound > heaviest - NEGLIGIBLE]
                fresh = rows[~self.known[trial.speed][rows]]
                # The same speed may have been executed twice: all its trials count.
                if not len(fresh):
                    continue
                x = simulate(self.z[fresh], trial.speed)
                self.positions[trial.speed][fresh] = x
                self.known[trial.speed][fresh] = True
                for other in trials:
                    if other.speed == trial.speed:
                        total[fresh] += other.log_likelihood(x)
                        pending[fresh] -= other.ceiling
            weight = (log_ratio + total)[rows]
            heaviest = max(heaviest, float(weight.max()) if len(rows) else -torch.inf)
        exact = torch.ones(num, dtype=torch.bool)
        for trial in trials:
            exact &= self.known[trial.speed]
        return total + pending, exact

    def _known(self, speed: float) -> Tensor:
        if speed not in self.known:
            self.known[speed] = torch.zeros(len(self), dtype=torch.bool)
            self.positions[speed] = torch.full_like(self.z, torch.nan)
        return self.known[speed]

    def _most_selective_first(self, trials: Sequence[Evidence]) -> list[Evidence]:
        """Order trials by the share of what was simulated that may explain them."""

        def share(trial: Evidence) -> float:
            x = self.positions[trial.speed][self.known[trial.speed]]
            if not len(x):
                return 1.0
            near = trial.log_likelihood(x) > trial.ceiling - NEAR
            return float(near.double().mean())

        return sorted(trials, key=share)


def _log_prob(density: KernelMixture | None, z: Tensor) -> Tensor:
    return log_normal(z) if density is None else density.log_prob(z)
