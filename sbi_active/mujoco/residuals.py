"""A ``residual_fn`` of ``mujoco.sysid`` as it is, as a deterministic simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import DiscreteActions
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.expected import require
from sbi_active.mujoco.models.parameters import Bounded
from sbi_active.mujoco.robot import Robot, named_box
from sbi_active.simulation import SimulatorModel


def free_parameters(params: Any) -> tuple[Bounded, ...]:
    """Return names and bounds of the parameters of a ``ParameterDict`` not frozen.

    Raises:
        ValueError: If there is none, or bounds are not finite and in order.
    """
    names = params.get_non_frozen_parameter_names()
    advice = "free the unknown ones"
    require(bool(names), "a parameter that is not frozen", "none", advice)
    each = zip(names, *params.get_bounds(), strict=True)
    return tuple(Bounded(name, float(low), float(high)) for name, low, high in each)


def from_residuals(residual_fn: Any, params: Any, *, noise: Any) -> Robot:
    """Return a robot whose outcome is minus the residual of each sequence.

    It runs in this process, since a spec is not sent to others.

    Args:
        residual_fn: ``residual_fn(x, params)`` of ``build_residual_fn``.
        params: A ``ParameterDict``.
        noise: Noise of the residuals.

    Raises:
        ValueError: If there is no noise.
    """
    advice = "pass noise=, in their units"
    require(noise is not None, "the noise of residuals", "none", advice)
    declared = free_parameters(params)
    function = _Residuals(residual_fn, params)
    names = [p.name for p in declared]
    simulator = SimulatorModel(function, noise=noise, parameter_names=names)
    number = torch.arange(len(function.lengths), dtype=torch.float32)[:, None]
    actions = DiscreteActions(number, names=["recording"])
    x = [np.zeros(length) for length in function.lengths]
    trials = Trials(number, x, action_labels=["recording"])
    return Robot(simulator, named_box(declared), actions, trials)


class _Residuals:
    """Minus the residuals of one sequence a row.

    Args:
        residual_fn: ``residual_fn(x, params)``.
        params: A ``ParameterDict``.
    """

    def __init__(self, residual_fn: Any, params: Any) -> None:
        self.residual_fn, self.params = residual_fn, params.copy()
        middle = np.mean(params.get_bounds(), axis=0)
        self.lengths = [len(each) for each in self.of(middle)]

    def of(self, theta: Array) -> list[Array]:
        """Return the residuals of all sequences, one array each."""
        found, *_ = self.residual_fn(theta, self.params)
        return [np.asarray(r, dtype=float).reshape(-1) for r in found]

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return minus the residuals, shape (n, length), NaN where there is none.

        Args:
            theta: Parameters, shape (n, d).
            action: Numbers of sequences, shape (n, 1).
        """
        rows, place = np.unique(
            theta.detach().cpu().double(), axis=0, return_inverse=True
        )
        known = [self.of(row) for row in rows]
        number = action[:, 0].round().long().tolist()
        x = np.full((len(theta), max(self.lengths)), np.nan)
        for i, (k, which) in enumerate(zip(place.reshape(-1), number, strict=True)):
            x[i, : self.lengths[which]] = -known[k][which]
        return torch.from_numpy(x).to(theta.dtype)
