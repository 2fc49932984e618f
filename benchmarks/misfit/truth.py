"""What the data of a case were made with, and plain fits to them; for scores only."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Uniform

from benchmarks.fitting import batched_fits
from benchmarks.misfit.discrepancies import Discrepancy
from benchmarks.misfit.machines import Machine
from benchmarks.misfit.machines.machine import is_positive, scale_of
from sbi_active.criticism import Context, Effect, Trials

#: Prior of phi in plain fits, in its declared deviations: as wide as the loop's widest.
WEAK = 3.0
#: Largest strength of an effect, in its declared deviations.
LARGEST = 6.0
FIRST = 1e-3  # strength at which the response is linear
LADDER = (0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 1.8, 3.0)
FINE = (0.8, 0.9, 1.0, 1.1, 1.25)
CLOSE = 1.3  # ratio of a size that is found to the one that is wanted


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A machine at a truth, and its trials.

    Attributes:
        machine: Where.
        theta: Shape (1, theta_dim), float64.
        action: Of all trials, shape (t, action_dim).
        fitted: Positions of the trials to fit.
    """

    machine: Machine
    theta: Tensor
    action: Tensor
    fitted: Tensor

    def respond(
        self,
        trial: Tensor,
        effects: Sequence[Effect] = (),
        strengths: Sequence[Tensor] = (),
        discrepancy: Discrepancy | None = None,
        strength: Tensor | None = None,
        theta: Tensor | None = None,
    ) -> Tensor:
        """Return readings without the sensor's error, a row each.

        Apart from the library's own augmented simulator, so that a mistake there does
        not make the data agree with it.

        Args:
            trial: Position of the trial of each row, shape (n,).
            effects: What the system has.
            strengths: Of these, each of shape (n, phi_dim).
            discrepancy: What nobody declared, or None.
            strength: Of it, shape (n,).
            theta: Shape (n, theta_dim); the truth's by default.
        """
        machine, own = self.machine, self.action[trial]
        if theta is None:
            theta = self.theta.expand(len(trial), -1)
        times = machine.times if machine.declares_times else None
        context = Context(trial.double(), times)
        parts = [*zip(effects, strengths, strict=True)]
        keywords: dict[str, Any] = {}
        for effect, phi in parts:
            if effect.hook == "dynamics":
                keywords = effect.apply(keywords, phi, own, context)

        def through(hook: str, value: Tensor) -> Tensor:
            for effect, phi in parts:
                if effect.hook == hook:
                    value = effect.apply(value, phi, own, context)
            return value

        added: Tensor | float = 0.0
        if discrepancy is not None and strength is not None:
            keywords["hidden"] = discrepancy.hidden(strength, trial)
            added = discrepancy.added(strength, trial)
        x = machine.fn(theta, through("action", own), **keywords) + added
        return through("observation", x)

    def predict(
        self, trial: Tensor, effects: Sequence[Effect], parameters: Tensor
    ) -> Tensor:
        """Return predictions of trials in sensor deviations, shape (n, m).

        Args:
            trial: Positions of the trials.
            effects: What the model has.
            parameters: Theta and strengths of the effects, shape (n, d).
        """
        n, t = len(parameters), len(trial)
        dims = [self.theta.shape[1], *[e.phi_dim for e in effects]]
        theta, *strengths = parameters.repeat_interleave(t, 0).split(dims, 1)
        x = self.respond(trial.repeat(n), effects, strengths, theta=theta)
        return x.reshape(n, -1) / self.machine.noise_sd

    def fit(
        self, effects: Sequence[Effect], target: Tensor, start: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return parameters and residuals of local fits to the trials to fit.

        Args:
            effects: What the model has.
            target: Readings in sensor deviations, shape (b, m).
            start: Theta and strengths of the effects, shape (b, d).
        """
        base = self.machine.prior.base_dist
        low, high = base.low.double(), base.high.double()
        scale, weak = high - low, torch.full_like(low, torch.inf)
        for effect in effects:
            prior: Any = getattr(effect.prior, "base_dist", effect.prior)
            inside = isinstance(prior, Uniform)
            sd = prior.stddev.double().reshape(-1) if inside else scale_of(effect)
            edge = torch.full_like(sd, torch.inf)
            least = torch.zeros_like(sd) if is_positive(effect) else -edge
            low = torch.cat([low, prior.low.double() if inside else least])
            high = torch.cat([high, prior.high.double() if inside else edge])
            scale = torch.cat([scale, sd])
            weak = torch.cat([weak, edge if inside else WEAK * sd])
        return batched_fits(
            lambda z: self.predict(self.fitted, effects, z).nan_to_num(1e6, 1e6),
            target,
            start,
            low=low,
            high=high,
            scale=scale,
            weak=weak,
        )

    def left(self, target: Tensor) -> Tensor:
        """Return the root mean square that the refitted bare model leaves, shape (b,).

        Args:
            target: Readings in sensor deviations, shape (b, m).
        """
        _, residual = self.fit((), target, self.theta.expand(len(target), -1))
        return residual.square().mean(1).sqrt()

    def readings(
        self,
        strength: Tensor,
        effects: Sequence[Effect] = (),
        discrepancy: Discrepancy | None = None,
    ) -> Tensor:
        """Return readings at several strengths in sensor deviations, shape (b, m).

        Args:
            strength: Of the discrepancy, shape (b,), or of one effect, (b, phi_dim).
            effects: The effect, where it is one.
            discrepancy: What nobody declared, or None.
        """
        rows = self.fitted.repeat(len(strength))
        each = strength.repeat_interleave(len(self.fitted), 0)
        x = self.respond(rows, effects, [each] * len(effects), discrepancy, each)
        return x.reshape(len(strength), -1) / self.machine.noise_sd

    def sized(
        self,
        target: float,
        readings: Callable[[Tensor], Tensor],
        *,
        largest: float = torch.inf,
    ) -> float | None:
        """Return the strength whose excess over the refitted bare model is as wanted.

        Args:
            target: Wanted root mean square, sensor deviations.
            readings: Strengths (b,) to readings (b, m) in sensor deviations.
            largest: That is allowed.

        Returns:
            None where no strength gives it.
        """

        def sizes(strengths: Tensor) -> Tensor:
            x = readings(strengths)
            found = self.left(x.nan_to_num(1e9, 1e9, -1e9))
            return found.where(x.isfinite().all(1), torch.nan)

        strength = FIRST
        for _ in range(2):  # a second time where the response has bent
            slope = float(sizes(torch.tensor([strength], dtype=torch.float64))[0])
            if not slope > 0:
                return None
            strength = min(strength * target / slope, largest)
        for factors in (LADDER, FINE):
            tried = strength * torch.tensor(factors, dtype=torch.float64)
            tried = tried.clamp(max=largest)
            size = sizes(tried)
            off = (size / target).log().abs().nan_to_num(nan=torch.inf)
            best = int(off.argmin())
            if float(off[best]) == torch.inf:
                return None
            strength = float(tried[best])
        if max(float(size[best]) / target, target / float(size[best])) > CLOSE:
            return None
        return strength


@dataclass(frozen=True, kw_only=True)
class Truth(Setup):
    """A case's truth, a setup with what else there is.

    Attributes:
        kind: "E", "R", "M", "P", "C" or "CE".
        effects: None, one or two.
        strengths: Of the effects, each of shape (1, phi_dim).
        sizes: Of the effects, root mean square that the refitted bare model leaves.
        discrepancy: What nobody declared, or None.
        strength: Of the discrepancy.
        size: Of the discrepancy, as that of an effect; in sensor deviations.
        error: The sensor's, shape of x of all trials.
    """

    kind: str
    effects: tuple[Effect, ...]
    strengths: tuple[Tensor, ...]
    sizes: tuple[float, ...]
    discrepancy: Discrepancy | None
    strength: float
    size: float
    error: Tensor

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def held_out(self) -> Tensor:
        """Positions of the other trials."""
        every = torch.arange(len(self.action))
        return every[~torch.isin(every, self.fitted)]

    def clean(self, trial: Tensor) -> Tensor:
        """Return what a sensor without error would read in trials."""
        n = len(trial)
        return self.respond(
            trial,
            self.effects,
            [s.expand(n, -1) for s in self.strengths],
            self.discrepancy,
            torch.full((n,), self.strength, dtype=torch.float64),
        )

    def measured(self, trial: Tensor) -> Tensor:
        """Return what the sensor reads in trials."""
        return self.clean(trial) + self.error[trial]

    def trials(self, x: Tensor | None = None, times: Tensor | None = None) -> Trials:
        """Return the trials to fit, as they were measured.

        Args:
            x: What was measured, if in other units.
            times: Of the samples, where those are declared.
        """
        x = self.measured(self.fitted) if x is None else x
        return Trials(
            self.action[self.fitted], x, index=self.fitted, sample_times=times
        )

    def refitted(self, effects: Sequence[Effect]) -> Tensor:
        """Return theta and strengths fitted to the measured trials, shape (1, d).

        Least squares from the true theta, once from the effects' nulls and once from
        the true strengths.
        """
        target = self.measured(self.fitted).flatten()[None] / self.machine.noise_sd
        true = dict(zip(self.names, self.strengths, strict=True))
        starts = [
            torch.cat([self.theta, *[_start(e, known) for e in effects]], 1)
            for known in ({}, true)
        ]
        z, residual = self.fit(effects, target, torch.cat(starts))
        return z[residual.square().sum(1).argmin()][None]

    def held_out_error(self, effects: Sequence[Effect]) -> float:
        """Return the root mean square error of a refitted model on held-out trials.

        Against readings without the sensor's error, in its standard deviations.
        """
        z, trial = self.refitted(effects), self.held_out
        x = self.predict(trial, effects, z)
        clean = self.clean(trial).flatten()[None] / self.machine.noise_sd
        return float((x - clean).square().mean().sqrt())


def _start(effect: Effect, known: Mapping[str, Tensor]) -> Tensor:
    if effect.name in known:
        return known[effect.name].double().reshape(1, -1)
    prior = getattr(effect.prior, "base_dist", effect.prior)
    if isinstance(prior, Uniform):
        return prior.mean.double().reshape(1, -1)
    return effect.null_phi(1, finite=True)
