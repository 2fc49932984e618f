"""What nobody declared: smooth, of a size that is known, and in no library.

- "process": a Gaussian process along the trial is added to x, a part of it shared by
  the trials. In world A, whose trials have one number, it is one of the action.
- "force": the same as a force (a flow) from outside.
- "wandering": a parameter of the machine wanders along the trial, in worlds A to C
  from trial to trial.
- "form": a force that depends on the state, or a term of the world's that its library
  lacks.

Judging seeds have other forms than tuning seeds, and half of their processes are rough
(Matern-3/2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.misfit.machines import Machine
from benchmarks.misfit.machines.machine import Hidden

LENGTHS = 0.07, 0.3  # of a trial: correlation lengths
SLOW_LENGTHS = 0.2, 0.6  # of what wanders
SHARED = 0.0, 0.5  # shares of the variance that all trials have together
JITTER = 1e-6


@dataclass(frozen=True)
class Discrepancy:
    """An undeclared discrepancy of strength one.

    Attributes:
        kind: "process", "force", "wandering" or "form".
        detail: What exactly.
        series: One a trial, shape (t, k): of numbers of x for a process, of steps for a
            force and what wanders; empty for a form.
        sign: Of a form.
    """

    kind: str
    detail: str
    series: Tensor
    sign: float = 1.0

    def hidden(self, strength: Tensor, trial: Tensor) -> Hidden:
        """Return what the machine is told of it.

        Args:
            strength: Shape (n,).
            trial: Position of the trial of each row, shape (n,).
        """
        if self.kind == "form":
            return {f"form {self.detail}": self.sign * strength}
        if self.kind == "process":
            return {}
        series = strength[:, None] * self.series[trial]
        if self.kind == "wandering":  # by a factor, which stays positive
            series = torch.expm1(series)
        return {self.detail: series}

    def added(self, strength: Tensor, trial: Tensor) -> Tensor | float:
        """Return what is added to x, arguments as for :meth:`hidden`."""
        if self.kind != "process":
            return 0.0
        return strength[:, None] * self.series[trial]


def draw_discrepancy(
    machine: Machine, action: Tensor, *, is_judged: bool
) -> Discrepancy:
    """Return a discrepancy by torch's generator.

    Args:
        machine: Where.
        action: Of all trials, shape (t, action_dim).
        is_judged: Whether forms are those on which nothing was tuned.
    """
    kinds = ["process", "wandering", "form", *["force"] * machine.takes_force]
    kind = one(kinds)
    num = len(action)
    nothing = torch.zeros(num, 0, dtype=torch.float64)
    rough = is_judged and bool(torch.rand(()) < 0.5)
    shared = one(SHARED)
    if kind == "form":
        name = one(machine.unseen_forms if is_judged else machine.forms)
        sign = 1.0 if name in machine.unsigned_forms else one((-1.0, 1.0))
        return Discrepancy(kind, name, nothing, sign)
    if kind == "wandering":
        name = one(machine.wandering)
        if machine.num_steps == 1:  # from trial to trial
            grid = torch.linspace(0, 1, num, dtype=torch.float64)
            series = smooth_series(grid, 1, _between(*SLOW_LENGTHS)).T
        else:
            length = _between(*SLOW_LENGTHS)
            series = smooth_series(_grid(machine), num, length, shared=shared)
        return Discrepancy(kind, name, series)
    length = _between(*LENGTHS)
    if kind == "force":
        series = smooth_series(_grid(machine), num, length, shared=shared, rough=rough)
        return Discrepancy(kind, "force", series)
    detail = f"length {length:.2f}, shared {shared:.1f}" + ", rough" * rough
    if machine.times is None:
        place = action[:, 0]
        place = (place - place.min()) / (place.max() - place.min())
        series = smooth_series(place, 1, length, rough=rough).T
    else:
        times = machine.times.double() / float(machine.times.max())
        series = smooth_series(times, num, length, shared=shared, rough=rough)
    return Discrepancy(kind, detail, machine.noise_sd * series)


def smooth_series(
    grid: Tensor, num: int, length: float, *, shared: float = 0.0, rough: bool = False
) -> Tensor:
    """Return draws of a Gaussian process of variance one by torch's generator.

    Args:
        grid: Places, shape (k,).
        num: How many.
        length: Of the kernel, in the units of the grid.
        shared: Share of the variance that all draws have together.
        rough: Matern-3/2 in place of squared exponential.

    Returns:
        Shape (num, k), float64.
    """
    distance = (grid[:, None] - grid).abs() / length
    if rough:
        kernel = (1 + 3**0.5 * distance) * torch.exp(-(3**0.5) * distance)
    else:
        kernel = torch.exp(-0.5 * distance**2)
    kernel = kernel + JITTER * torch.eye(len(grid), dtype=grid.dtype)
    factor = torch.linalg.cholesky(kernel)
    common = torch.randn(1, len(grid), dtype=grid.dtype)
    own = torch.randn(num, len(grid), dtype=grid.dtype)
    return (shared**0.5 * common + (1 - shared) ** 0.5 * own) @ factor.T


def _grid(machine: Machine) -> Tensor:
    steps = torch.arange(machine.num_steps, dtype=torch.float64)
    return (steps + 0.5) / machine.num_steps


def one(among: Sequence):
    """Return one of them by torch's generator."""
    return among[int(torch.randint(len(among), (1,)))]


def _between(low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand(()))
