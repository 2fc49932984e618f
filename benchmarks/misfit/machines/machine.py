"""What a machine is: a simulator, its sensor, and what it may lack."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import HalfNormal

from benchmarks.criticism.worlds.world import (
    drifted,
    effect,
    normal,
    shifted,
    stretched,
)
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect

#: Name of a form or of a parameter that wanders, to one number or one series a row.
Hidden = Mapping[str, Tensor]


@dataclass(frozen=True)
class Form:
    """A force (or a flow) that nobody declared, as a function of the scaled state.

    Attributes:
        apply: Of two tensors of shape (n,), giving (n,).
        signed: Whether either sign makes sense; friction brakes.
    """

    apply: Callable[[Tensor, Tensor], Tensor]
    signed: bool = True


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A bare simulator with a declared sensor.

    Attributes:
        name: One word.
        fn: ``fn(theta, action, *, times, hidden, **effects)``, noise-free, float64.
            ``hidden`` is for the truth alone.
        prior: Of theta.
        parameter_names: Of theta.
        draw_actions: ``draw_actions(num)``, shape (num, action_dim), by torch's
            generator.
        noise_sd: The sensor's error.
        times: Of the samples of a trial; None without a time axis.
        num_trials: To fit; as many are held out.
        library: The declared effects.
        fast: Names of effects that act within a few samples.
        slow: Names of effects that act over a trial or more.
        forms: Undeclared ones by name, for tuning seeds.
        unseen_forms: For judging seeds; nothing was tuned on them.
        unsigned_forms: Those of both whose strength is positive.
        wandering: What may wander, by the name that ``hidden`` takes.
        num_steps: Of a series in ``hidden``; 1 where a trial has one number.
        takes_force: Whether ``hidden`` has "force", a series from outside.
        declares_times: Whether the loop is told of the times.
        equivalences: Names of effects ("none" included) that no action separates.
    """

    name: str
    fn: Callable[..., Tensor]
    prior: BoxUniform
    parameter_names: Sequence[str]
    draw_actions: Callable[[int], Tensor]
    noise_sd: float
    times: Tensor | None
    num_trials: int
    library: Sequence[Effect]
    fast: Sequence[str]
    slow: Sequence[str]
    forms: Sequence[str]
    unseen_forms: Sequence[str]
    unsigned_forms: Sequence[str] = ()
    wandering: Sequence[str] = ()
    num_steps: int = 1
    takes_force: bool = True
    declares_times: bool = True
    equivalences: Sequence[frozenset[str]] = field(default_factory=tuple)

    def model(self) -> SimulatorModel:
        """Return the bare simulator with the noise that is declared, the sensor's."""
        return SimulatorModel(
            self.fn,
            noise=GaussianNoise(self.noise_sd),
            parameter_names=[*self.parameter_names],
            sample_times=self.times if self.declares_times else None,
        )

    def effect(self, name: str) -> Effect:
        """Return a declared effect by its name."""
        return next(own for own in self.library if own.name == name)

    def equivalent(self, name: str) -> frozenset[str]:
        """Return the names that count as one with a name, itself included."""
        groups = [group for group in self.equivalences if name in group]
        return frozenset({name}).union(*groups)


def sample_times(duration: float, num: int) -> Tensor:
    """Return evenly spaced times up to the end of a trial, shape (num,), float64."""
    return torch.linspace(0, duration, num + 1, dtype=torch.float64)[1:]


def is_positive(effect: Effect) -> bool:
    """Return whether phi has a half-normal prior."""
    return isinstance(getattr(effect.prior, "base_dist", None), HalfNormal)


def scale_of(effect: Effect) -> Tensor:
    """Return the scale of a normal or half-normal prior, shape (phi_dim,), float64."""
    prior: Any = getattr(effect.prior, "base_dist", effect.prior)
    return prior.scale.double().reshape(-1)


def sensor_effects(*, bias: float, gain: float, drift: float) -> list[Effect]:
    """Return bias, gain and drift of a sensor.

    Args:
        bias: Prior standard deviation, in the units of x.
        gain: Likewise, relative.
        drift: Likewise, in the units of x a trial.
    """
    parts = (
        *(("bias", bias, shifted), ("sensor gain", gain, stretched)),
        ("drift", drift, drifted),
    )
    return [effect(name, "observation", normal(sd), f) for name, sd, f in parts]


def box(*ranges: tuple[float, float]) -> BoxUniform:
    """Return a uniform prior."""
    low, high = torch.tensor(ranges).T
    return BoxUniform(low, high)


def uniform_rows(
    num: int, *ranges: tuple[float, float], signed: bool = False
) -> Tensor:
    """Return rows of uniform numbers by torch's generator, float64.

    Args:
        num: Number of rows.
        ranges: Ends of each number.
        signed: Whether the first number may have either sign.
    """
    low, high = torch.tensor(ranges, dtype=torch.float64).T
    rows = low + (high - low) * torch.rand(num, len(low), dtype=torch.float64)
    if signed:
        rows[:, 0] *= 2.0 * torch.randint(2, (num,)).double() - 1
    return rows
